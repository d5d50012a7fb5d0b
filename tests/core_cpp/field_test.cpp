// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "field/encodings.hpp"
#include "field/field_loss.hpp"
#include "field/mlp.hpp"
#include "helpers.hpp"

namespace radarsdf {
namespace {

// A network's numbers and its gradients.
struct Network {
  Network(const std::vector<std::int64_t>& widths, unsigned seed) {
    for (std::size_t i = 0; i + 1 < widths.size(); ++i) {
      weights.push_back(
          test::normal_numbers<double>(widths[i] * widths[i + 1], 0.5, seed + 2 * static_cast<unsigned>(i)));
      biases.push_back(test::normal_numbers<double>(widths[i + 1], 0.3, seed + 2 * static_cast<unsigned>(i) + 1));
      by_weights.emplace_back(weights[i].size(), 99.0);
      by_biases.emplace_back(biases[i].size(), 99.0);
    }
    for (std::size_t i = 0; i < weights.size(); ++i) {
      layers.push_back({weights[i].data(), biases[i].data(), widths[i], widths[i + 1]});
      gradients.push_back({by_weights[i].data(), by_biases[i].data()});
    }
  }
  Network(const Network&) = delete;
  Network& operator=(const Network&) = delete;

  std::vector<std::vector<double>> weights, biases, by_weights, by_biases;
  std::vector<Layer<double>> layers;
  std::vector<LayerGradients<double>> gradients;
};

// Checks some of the gradients against central differences of `loss`.
template <typename Loss>
void check_gradient(std::vector<double>& numbers, const std::vector<double>& gradient, const Loss& loss) {
  REQUIRE(numbers.size() == gradient.size());
  double largest = 0;
  for (const double g : gradient) largest = std::max(largest, std::abs(g));
  CHECK(largest > 0);
  const std::size_t step = std::max<std::size_t>(1, numbers.size() / 25);
  for (std::size_t i = 0; i < numbers.size(); i += step) {
    constexpr double kStep = 1e-6;
    const double before = numbers[i];
    numbers[i] = before + kStep;
    const double above = loss();
    numbers[i] = before - kStep;
    const double below = loss();
    numbers[i] = before;
    REQUIRE(std::abs((above - below) / (2 * kStep) - gradient[i]) < 1e-6 * (1 + largest));
  }
}

template <typename Loss>
void check_network(Network& network, const Loss& loss) {
  for (std::size_t i = 0; i < network.layers.size(); ++i) {
    const auto by_weights = network.by_weights[i], by_biases = network.by_biases[i];  // the loss writes them again
    check_gradient(network.weights[i], by_weights, loss);
    check_gradient(network.biases[i], by_biases, loss);
  }
}

}  // namespace

TEST_CASE("spherical harmonics are orthonormal") {
  // Gauss-Legendre with four nodes is exact to degree 7, eight equal steps round to order 7; a product has degree 6.
  const double nodes[4] = {-0.8611363115940526, -0.3399810435848563, 0.3399810435848563, 0.8611363115940526};
  const double shares[4] = {0.3478548451374538, 0.6521451548625461, 0.6521451548625461, 0.3478548451374538};
  const double pi = std::acos(-1.0);
  std::vector<double> directions, weights;
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 8; ++j) {
      const double radius = std::sqrt(1 - nodes[i] * nodes[i]), angle = 2 * pi * j / 8 + 0.1;
      directions.insert(directions.end(), {radius * std::cos(angle), radius * std::sin(angle), nodes[i]});
      weights.push_back(shares[i] * 2 * pi / 8);
    }
  }
  std::vector<double> values(weights.size() * kHarmonics);
  spherical_harmonics(directions.data(), static_cast<std::int64_t>(weights.size()), values.data(), kHarmonics, 1);
  for (std::size_t a = 0; a < kHarmonics; ++a) {
    for (std::size_t b = 0; b < kHarmonics; ++b) {
      double product = 0;
      for (std::size_t i = 0; i < weights.size(); ++i) {
        product += weights[i] * values[kHarmonics * i + a] * values[kHarmonics * i + b];
      }
      REQUIRE(product == doctest::Approx(a == b ? 1 : 0).epsilon(1e-12));
    }
  }
}

TEST_CASE("a network is its layers, and its gradients are those of differences") {
  constexpr std::int64_t kCount = 150, kWide = 7, kNarrow = 5, kOutputs = 3;
  Network network({kWide + kNarrow, 20, 9, kOutputs}, 1);
  auto wide = test::normal_numbers<double>(kWide * kCount, 1, 10),
       narrow = test::normal_numbers<double>(kNarrow * kCount, 1, 11);
  const auto grad = test::normal_numbers<double>(kOutputs * kCount, 1, 12);
  const std::vector<Columns<const double>> inputs = {{wide.data(), kWide, kWide}, {narrow.data(), kNarrow, kNarrow}};
  std::vector<double> out(kOutputs * kCount);
  std::vector<double> hidden(static_cast<std::size_t>(mlp_hidden_columns(network.layers) * kCount));
  const auto loss = [&] {
    mlp(network.layers, inputs, kCount, hidden.data(), out.data(), 1);
    return test::dot(out, grad);
  };
  test::for_each_instruction_set([&] {
    loss();
    for (std::size_t n = 0; n < kCount; ++n) {
      std::vector<double> x(wide.begin() + static_cast<std::ptrdiff_t>(kWide * n),
                            wide.begin() + static_cast<std::ptrdiff_t>(kWide * (n + 1)));
      x.insert(x.end(), narrow.begin() + static_cast<std::ptrdiff_t>(kNarrow * n),
               narrow.begin() + static_cast<std::ptrdiff_t>(kNarrow * (n + 1)));
      for (std::size_t i = 0; i < network.layers.size(); ++i) {
        std::vector<double> y = network.biases[i];
        for (std::size_t r = 0; r < y.size(); ++r) {
          for (std::size_t k = 0; k < x.size(); ++k) y[r] += network.weights[i][r * x.size() + k] * x[k];
          if (i + 1 < network.layers.size()) y[r] = std::max(y[r], 0.0);
        }
        x = y;
      }
      for (std::size_t r = 0; r < kOutputs; ++r) REQUIRE(std::abs(out[kOutputs * n + r] - x[r]) < 1e-12);
    }
    std::vector<double> by_wide(wide.size()), by_narrow(narrow.size()), first;
    for (const int threads : test::kThreads) {
      mlp_backward<double>(network.layers, inputs, kCount, hidden.data(), {grad.data(), kOutputs, kOutputs},
                           network.gradients, {{by_wide.data(), kWide, kWide}, {by_narrow.data(), kNarrow, kNarrow}},
                           threads);
      if (first.empty()) first = network.by_weights[0];
      CHECK(network.by_weights[0] == first);
    }
    check_network(network, loss);
    check_gradient(wide, by_wide, loss);
    check_gradient(narrow, by_narrow, loss);
  });
}

namespace {

// A field on random points, with a batch of samples.
struct Scene {
  static constexpr std::int64_t kCount = 60, kNear = 40;
  static constexpr int kLevels = 2;

  Scene(Encoding encoding, IntensityInputs sees_what, bool in_free_space)
      : points(test::normal_numbers<double>(3 * kCount, 0.5, 20)),
        table(test::table_of(points, 0.3, kLevels, encoding)),
        features(test::normal_numbers<double>(kFeatureDim * table.num_rows(), 1, 21)),
        sdf_m(test::normal_numbers<double>(kCount, 0.2, 22)),
        directions(test::unit_vectors<double>(kCount, 23)),
        sees(sees_what),
        free_space(in_free_space),
        cells(encoding == Encoding::kOctree ? kFeatureDim : kFeatureDim * kLevels),
        sdf({cells + 6 * kFrequencies.count, 17, 1 + kFeature}, 30),
        intensity(
            {cells + 6 * kFrequencies.count + kFeature + sees.sdf + kHarmonics * sees.view_direction + sees.log_range,
             11, 1},
            40),
        located(kLevels * kCount),
        by_interpolated(kFeatureDim * kLevels * kCount) {
    const auto numbers = test::normal_numbers<double>(kCount, 1, 24);
    for (std::size_t i = 0; i < kCount; ++i) {
      rays.insert(rays.end(), points.begin() + static_cast<std::ptrdiff_t>(3 * i),
                  points.begin() + static_cast<std::ptrdiff_t>(3 * i + 3));
      rays.insert(rays.end(), directions.begin() + static_cast<std::ptrdiff_t>(3 * i),
                  directions.begin() + static_cast<std::ptrdiff_t>(3 * i + 3));
      rays.insert(rays.end(), {5 + std::abs(numbers[i]), numbers[i]});
    }
  }

  FieldParameters<double> parameters() const {
    return {&table, features.data(), kFrequencies, sdf.layers, intensity.layers, sees};
  }
  FieldLoss<double> loss() const {
    return FieldLoss<double>(parameters(), {0.1, free_space}, {sdf.gradients, intensity.gradients});
  }
  LossBatch<double> batch() const {
    // In two parts, which are not equal.
    LossBatch<double> all{points.data(), sdf_m.data(), {{35, 30}, {kCount - 35, kNear - 30}},
                          rays.data(),   kRayColumns,  {}};
    all.dropout[0] = {5, 200};
    return all;
  }
  FeatureGradients<double> by_features() { return {located.data(), by_interpolated.data()}; }
  std::vector<double> features_gradient() const {
    std::vector<double> gradient(features.size());
    scatter<double>(table, {points.data(), nullptr, located.data(), kCount}, by_interpolated.data(),
                    kFeatureDim * kLevels, gradient.data(), 1);
    return gradient;
  }

  static constexpr Frequencies kFrequencies{8, 0, 2};
  static constexpr std::int64_t kFeature = 4;
  std::vector<double> points;
  VertexTable table;
  std::vector<double> features, sdf_m, directions, rays;
  IntensityInputs sees;
  bool free_space;
  std::int64_t cells;
  Network sdf, intensity;
  std::vector<std::int32_t> located;
  std::vector<double> by_interpolated;
};

}  // namespace

TEST_CASE("the gradients of the losses are those of differences") {
  for (const Encoding encoding : {Encoding::kTriQuadtree, Encoding::kOctree}) {
    for (const bool all : {true, false}) {
      Scene scene(encoding, {all, all, all}, all);
      FieldLoss<double> loss = scene.loss();
      Crew crew(2);

      const auto geometry = [&] {
        loss.begin_sdf(scene.batch(), 0.7, scene.by_features(), crew);
        return 0.7 * loss.finish(crew).sdf;
      };
      geometry();
      check_gradient(scene.features, scene.features_gradient(), geometry);
      check_network(scene.sdf, geometry);

      const auto joint = [&] {
        loss.begin_joint(scene.batch(), {0.7, 1.3}, scene.by_features(), crew);
        const FieldLosses found = loss.finish(crew);
        return 0.7 * found.sdf + 1.3 * found.intensity;
      };
      joint();
      check_gradient(scene.features, scene.features_gradient(), joint);
      check_network(scene.sdf, joint);
      joint();
      check_network(scene.intensity, joint);

      const auto by_sdf = scene.sdf.by_weights;
      const auto reflectance = [&] {
        loss.begin_intensity(scene.batch(), 1.3, crew);
        return 1.3 * loss.finish(crew).intensity;
      };
      reflectance();
      check_network(scene.intensity, reflectance);
      CHECK(scene.sdf.by_weights == by_sdf);  // the geometry is frozen
    }
  }
}

TEST_CASE("the losses are what their names say") {
  Scene scene(Encoding::kOctree, {true, true, true}, false);
  // A logit of zero, and a prediction of zero, at every point.
  for (Network* network : {&scene.sdf, &scene.intensity}) {
    std::fill(network->weights.back().begin(), network->weights.back().end(), 0.0);
    std::fill(network->biases.back().begin(), network->biases.back().end(), 0.0);
  }
  FieldLoss<double> loss = scene.loss();
  Crew crew(1);
  loss.begin_joint(scene.batch(), {1, 1}, scene.by_features(), crew);
  const FieldLosses found = loss.finish(crew);
  CHECK(found.sdf == doctest::Approx(std::log(2.0)));  // the cross-entropy of a half and any label
  double sum = 0;
  for (std::size_t i = 0; i < Scene::kCount; ++i) {  // those with a label come first in each part
    if (i < 30 || (i >= 35 && i < 35 + Scene::kNear - 30)) sum += std::abs(scene.rays[kRayColumns * i + kRayIntensity]);
  }
  CHECK(found.intensity == doctest::Approx(sum / Scene::kNear));
}

TEST_CASE("a loss of parts that do not fit is refused") {
  Scene scene(Encoding::kOctree, {true, true, true}, false);
  const NetworkGradients<double> gradients{scene.sdf.gradients, scene.intensity.gradients};
  const auto refused = [&](const auto& change) {
    FieldParameters<double> parameters = scene.parameters();
    LossOptions options{0.1, false};
    change(parameters, options);
    CHECK_THROWS_AS(FieldLoss<double>(parameters, options, gradients), std::invalid_argument);
  };
  refused([](auto& p, auto&) { p.frequencies.count = 3; });
  refused([](auto& p, auto&) { p.frequencies = {8, 23, 2}; });
  refused([](auto& p, auto&) { p.frequencies.half_width_m = 0; });
  refused([](auto& p, auto&) { p.sees.sdf = false; });
  refused([](auto& p, auto&) { p.sdf.clear(); });
  refused([](auto& p, auto&) { p.sdf[1].inputs = 5; });
  refused([](auto& p, auto&) { p.intensity.clear(); });
  refused([](auto&, auto& o) { o.sigma_m = 0; });
  FieldParameters<double> alone = scene.parameters();
  alone.intensity.clear();
  FieldLoss<double> geometry(alone, {0.1, false}, {scene.sdf.gradients, {}});
  Crew crew(1);
  geometry.begin_sdf(scene.batch(), 1, scene.by_features(), crew);
  CHECK(geometry.finish(crew).sdf > 0);
  CHECK_THROWS_AS(geometry.begin_intensity(scene.batch(), 1, crew), std::invalid_argument);
  CHECK_THROWS_AS(geometry.begin_joint(scene.batch(), {1, 1}, scene.by_features(), crew), std::invalid_argument);
  CHECK_THROWS_AS(geometry.finish(crew), std::logic_error);
}

}  // namespace radarsdf
