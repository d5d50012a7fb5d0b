// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/cell_means.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <stdexcept>
#include <vector>

#include "helpers.hpp"

namespace {

using radarsdf::CellKind;

const std::vector<CellKind> kKinds{{4, 0, 0}, {1, 0.2, 0}, {1, 0, 0.1}};
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

struct Returns {
  std::vector<float> points, directions, incidence_rad;
  std::size_t size() const { return incidence_rad.size(); }
  radarsdf::Views views() const {
    return {points.data(), directions.data(), incidence_rad.data(), static_cast<std::int64_t>(size())};
  }
};

Returns returns(std::int64_t count) {
  Returns made{test::normal_numbers<float>(3 * count, 3, 1), test::unit_vectors<float>(count, 2),
               test::normal_numbers<float>(count, 0.5, 3)};
  for (std::size_t i = 0; i < made.size(); ++i) {
    made.incidence_rad[i] = i % 7 == 0 ? kNan : std::min(std::abs(made.incidence_rad[i]), 1.57F);
  }
  return made;
}

// The cell of a return, by the definition: bins of its position, and of direction or incidence if the kind asks.
using Cell = std::array<double, 7>;
Cell cell_of(const CellKind& kind, const Returns& all, std::size_t i, double offset) {
  Cell cell{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    cell[axis] = std::floor(double{all.points[3 * i + axis]} / kind.edge_m + offset);
    if (kind.direction_step > 0) {
      cell[3 + axis] = std::floor(double{all.directions[3 * i + axis]} / kind.direction_step + offset + 0.37);
    }
  }
  if (kind.incidence_step_rad > 0) {
    const double angle = double{all.incidence_rad[i]};
    cell[6] = std::isnan(angle) ? -2 : std::floor(angle / kind.incidence_step_rad + offset);
  }
  return cell;
}

struct Mean {
  double sum = 0, mass = 0, mean = 0;
};

// What the means of one tiling explain of each value: each kind in turn takes the means of what the others leave.
std::vector<double> explained_by(int tiling, int num_tilings, const Returns& all, const std::vector<float>& values,
                                 const std::vector<float>& weights, double shrinkage, int rounds) {
  std::vector<double> left(values.begin(), values.end()), weight(weights.begin(), weights.end());
  std::vector<std::map<Cell, Mean>> kinds(kKinds.size());
  const auto each = [&](std::size_t k, const auto& visit) {
    for (std::size_t i = 0; i < all.size(); ++i) {
      visit(i, kinds[k][cell_of(kKinds[k], all, i, static_cast<double>(tiling) / num_tilings)]);
    }
  };
  for (int round = 0; round < rounds; ++round) {
    for (std::size_t k = 0; k < kinds.size(); ++k) {
      each(k, [&](std::size_t i, Mean& cell) {
        left[i] += cell.mean;
        cell.sum += weight[i] * left[i];
        cell.mass += weight[i];
      });
      for (auto& own : kinds[k]) own.second = {0, 0, own.second.sum / (own.second.mass + shrinkage)};
      each(k, [&](std::size_t i, const Mean& cell) { left[i] -= cell.mean; });
    }
    if (round > 0 || rounds == 1) continue;
    std::vector<double> sizes;
    for (const double own : left) sizes.push_back(std::abs(own));
    std::sort(sizes.begin(), sizes.end());
    const double scale = 2 * sizes[sizes.size() / 2];
    for (std::size_t i = 0; i < left.size(); ++i) weight[i] /= std::sqrt(1 + left[i] / scale * left[i] / scale);
  }
  for (std::size_t i = 0; i < left.size(); ++i) left[i] = double{values[i]} - left[i];
  return left;
}

radarsdf::CellMeans fit(const Returns& all, int num_tilings, const std::vector<float>& values,
                        const std::vector<float>& weights, double shrinkage, int rounds, int threads = 1) {
  return radarsdf::fit_cell_means(kKinds, num_tilings, all.views(), values.data(), weights.data(),
                                  {shrinkage, rounds, 0}, threads);
}

radarsdf::CellMeansAt answers(const radarsdf::CellMeans& means, int num_tilings) {
  return {kKinds, num_tilings, means.keys.data(), means.means.data(), static_cast<std::int64_t>(means.keys.size())};
}

}  // namespace

TEST_CASE("means in cells are those of the definition") {
  constexpr int kTilings = 3;
  const Returns all = returns(2000);
  std::vector<float> values = test::normal_numbers<float>(2000, 1, 4), weights;
  for (std::size_t i = 0; i < values.size(); ++i) {
    values[i] += all.points[3 * i] + 2 * all.directions[3 * i + 1];
    weights.push_back(0.5F + static_cast<float>(i % 5));
  }
  for (const int rounds : {1, 2, 4}) {
    std::vector<double> expected(values.size());
    for (int tiling = 0; tiling < kTilings; ++tiling) {
      const auto own = explained_by(tiling, kTilings, all, values, weights, 5, rounds);
      for (std::size_t i = 0; i < own.size(); ++i) expected[i] += own[i] / kTilings;
    }
    const auto means = fit(all, kTilings, values, weights, 5, rounds);
    for (const int threads : test::kThreads) {
      const auto again = fit(all, kTilings, values, weights, 5, rounds, threads);
      CHECK(again.keys == means.keys);
      CHECK(again.means == means.means);
      CHECK(again.explained == means.explained);
      std::vector<float> sums(values.size());
      answers(means, kTilings).sums(all.views(), sums.data(), threads);
      for (std::size_t i = 0; i < sums.size(); ++i) {
        REQUIRE(std::abs(double{sums[i]} - expected[i]) < 1e-5);
        REQUIRE(std::abs(double{means.explained[i]} - expected[i]) < 1e-5);
      }
    }
  }
}

TEST_CASE("a value that is far off moves a mean little after the first round") {
  Returns all;
  std::vector<float> values;
  for (int i = 0; i < 101; ++i) {
    all.points.insert(all.points.end(), {0.5F, 0.5F, 0.5F});
    all.directions.insert(all.directions.end(), {1, 0, 0});
    all.incidence_rad.push_back(0.25F);
    values.push_back(i == 100 ? 1000.0F : static_cast<float>(i % 2));
  }
  const std::vector<float> weights(values.size(), 1.0F);
  CHECK(fit(all, 1, values, weights, 0.01, 1).explained[0] > 9);
  CHECK(fit(all, 1, values, weights, 0.01, 12).explained[0] < 2);
}

TEST_CASE("cells are numbered as they first occur, on both sides of zero") {
  const Returns all{{0.1F, 0, 0, -0.1F, 0, 0, 0.9F, 0, 0, 0.1F, 0, 1.5F, 0.1F, 0, 0, -1.0F, 0, 0},
                    {1, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 1, 0, 0},
                    {0.05F, 0.05F, 0.05F, 0.05F, kNan, 0.15F}};
  std::vector<std::int32_t> rows(all.size());
  const auto number = [&](const CellKind& kind) { return radarsdf::cell_rows(kind, all.views(), rows.data()); };
  CHECK(number({1, 0, 0}) == 3);
  CHECK(rows == std::vector<std::int32_t>{0, 1, 0, 2, 0, 1});
  CHECK(number({1, 0.5, 0}) == 4);
  CHECK(rows == std::vector<std::int32_t>{0, 1, 0, 2, 3, 1});
  CHECK(number({1, 0, 0.1}) == 5);  // an unknown angle is a cell of its own
  CHECK(rows == std::vector<std::int32_t>{0, 1, 0, 2, 3, 4});
}

TEST_CASE("places that cannot be, and returns that there are not") {
  Returns all = returns(50);
  constexpr float kFar = 3e38F;
  all.points[0] = kNan;
  all.points[4] = std::numeric_limits<float>::infinity();
  all.points[8] = -kFar;
  const std::vector<float> ones(all.size(), 1.0F);
  const auto means = fit(all, 2, ones, ones, 1, 2);
  CHECK(std::all_of(means.explained.begin(), means.explained.end(), [](float v) { return std::isfinite(v); }));

  const Returns elsewhere{{1e6F, 0, 0}, {1, 0, 0}, {0.1F}};
  float sum = -7;
  answers(means, 2).sums(elsewhere.views(), &sum, 1);
  CHECK(sum == 0);

  const auto nothing = fit(Returns{}, 2, {}, {}, 1, 2);
  CHECK(nothing.keys.empty());
  CHECK(nothing.explained.empty());
  answers(nothing, 2).sums(elsewhere.views(), &sum, 1);
  CHECK(sum == 0);
  CHECK(radarsdf::cell_rows(kKinds[0], Returns{}.views(), nullptr) == 0);

  radarsdf::CellMeans twice = means;
  twice.keys[1] = twice.keys[0];
  CHECK_THROWS_AS(answers(twice, 2), std::invalid_argument);
  twice.keys[1] = radarsdf::kEmptyKey;
  CHECK_THROWS_AS(answers(twice, 2), std::invalid_argument);
}
