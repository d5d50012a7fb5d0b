// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The kernels against plain loops, on every instruction set of this processor.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "field/encodings.hpp"
#include "field/optimiser.hpp"
#include "helpers.hpp"
#include "kernels/product_kernels.hpp"
#include "util/crew.hpp"

namespace radarsdf {
namespace {

constexpr double kSize = 0.2;
constexpr int kLevels = 3;
constexpr std::int64_t kPoints = 700;
constexpr std::int64_t kStride = kFeatureDim * kLevels;

template <typename T>
constexpr double kTolerance = sizeof(T) == 4 ? 2e-5 : 1e-13;

// Some points in cells, some in none, some on the faces of cells.
template <typename T>
struct Scene {
  explicit Scene(Encoding encoding)
      : inside(test::normal_numbers<T>(3 * kPoints, 0.5, 1)),
        table(test::table_of(inside, kSize, kLevels, encoding)),
        points(test::normal_numbers<T>(3 * kPoints, 0.7, 2)),
        directions(test::normal_numbers<T>(3 * kPoints, 1, 3)),
        features(test::normal_numbers<T>(kFeatureDim * table.num_rows(), 1, 4)),
        grad(test::normal_numbers<T>(kStride * kPoints, 1, 5)),
        located(kLevels * kPoints) {
    for (std::size_t i = 0; i < 30; ++i)
      points[i] = static_cast<T>(0.2 * static_cast<double>(static_cast<int>(i) - 15));
    table.locate(points.data(), kPoints, located.data());
  }

  PointBatch<T> batch(bool directional) const {
    return {points.data(), directional ? directions.data() : nullptr, located.data(), kPoints};
  }

  std::vector<T> inside;
  VertexTable table;
  std::vector<T> points, directions, features, grad;
  std::vector<std::int32_t> located;
};

// Bilinear on three planes, or trilinear in space, written as the formula; or its derivative along a direction.
template <typename T>
std::vector<double> reference(const Scene<T>& scene, bool directional) {
  const bool planes = scene.table.encoding() == Encoding::kTriQuadtree;
  const std::vector<std::vector<int>> groups =
      planes ? std::vector<std::vector<int>>{{0, 1}, {0, 2}, {1, 2}} : std::vector<std::vector<int>>{{0, 1, 2}};
  std::vector<double> out(kStride * kPoints);
  for (std::size_t n = 0; n < kPoints; ++n) {
    for (std::size_t level = 0; level < kLevels; ++level) {
      const std::int32_t cell = scene.located[kLevels * n + level];
      if (cell < 0) continue;
      const double size = kSize * (1 << level);
      double fraction[3];
      for (std::size_t axis = 0; axis < 3; ++axis) {
        // As the core rounds the position, or points on a face would be taken for another cell's.
        const T u = scene.points[3 * n + axis] * static_cast<T>(1 / kSize) / static_cast<T>(1 << level);
        fraction[axis] = static_cast<double>(u) - std::floor(static_cast<double>(u));
      }
      std::size_t corner = 0;
      for (const std::vector<int>& axes : groups) {
        for (std::size_t c = 0; c < std::size_t{1} << axes.size(); ++c, ++corner) {
          double weight = directional ? 0 : 1;
          for (std::size_t along = 0; along < (directional ? axes.size() : 1); ++along) {
            double product = 1;
            for (std::size_t i = 0; i < axes.size(); ++i) {
              const bool upper = c >> i & 1;
              const double f = fraction[axes[i]];
              if (directional && i == along) {
                product *= (upper ? 1 : -1) / size *
                           static_cast<double>(scene.directions[3 * n + static_cast<std::size_t>(axes[i])]);
              } else {
                product *= upper ? f : 1 - f;
              }
            }
            weight = directional ? weight + product : product;
          }
          const auto row = static_cast<std::size_t>(scene.table.cells()[static_cast<std::size_t>(cell)].rows[corner]);
          for (std::size_t d = 0; d < kFeatureDim; ++d) {
            out[n * kStride + level * kFeatureDim + d] +=
                weight * static_cast<double>(scene.features[row * kFeatureDim + d]);
          }
        }
      }
    }
  }
  return out;
}

template <typename T>
void check_close(const std::vector<T>& found, const std::vector<double>& expected, double tolerance) {
  double scale = 0, worst = 0;
  for (std::size_t i = 0; i < found.size(); ++i) {
    scale = std::max(scale, std::abs(expected[i]));
    worst = std::max(worst, std::abs(static_cast<double>(found[i]) - expected[i]));
  }
  CHECK(scale > 0);
  CHECK(worst < tolerance * scale);
}

TEST_CASE_TEMPLATE("interpolation is bilinear on planes and trilinear in space", T, float, double) {
  test::for_each_instruction_set([] {
    for (const Encoding encoding : {Encoding::kTriQuadtree, Encoding::kOctree}) {
      const Scene<T> scene(encoding);
      for (const bool directional : {false, true}) {
        const std::vector<double> expected = reference(scene, directional);
        std::vector<T> first;
        for (const int threads : test::kThreads) {
          std::vector<T> out(kStride * kPoints, T(99));
          interpolate(scene.table, scene.features.data(), scene.batch(directional), out.data(), kStride, threads);
          check_close(out, expected, kTolerance<T>);
          if (first.empty()) first = out;
          CHECK(out == first);
        }
        if (directional) continue;
        std::vector<std::int32_t> located(scene.located.size());
        std::vector<T> out(kStride * kPoints);
        encode(scene.table, scene.features.data(), scene.points.data(), kPoints, located.data(), out.data(), kStride,
               1);
        CHECK(out == first);
        CHECK(located == scene.located);
      }
    }
  });
}

TEST_CASE_TEMPLATE("scatter is the transpose of interpolate", T, float, double) {
  test::for_each_instruction_set([] {
    for (const Encoding encoding : {Encoding::kTriQuadtree, Encoding::kOctree}) {
      const Scene<T> scene(encoding);
      for (const bool directional : {false, true}) {
        std::vector<T> out(kStride * kPoints), first;
        interpolate(scene.table, scene.features.data(), scene.batch(directional), out.data(), kStride, 1);
        for (const int threads : test::kThreads) {
          std::vector<T> by_features(scene.features.size());
          scatter(scene.table, scene.batch(directional), scene.grad.data(), kStride, by_features.data(), threads);
          const double left = test::dot(out, scene.grad), right = test::dot(scene.features, by_features);
          const double scale = std::sqrt(test::dot(out, out) * test::dot(scene.grad, scene.grad));
          CHECK(std::abs(left - right) < kTolerance<T> * scale);
          CHECK(scale > 0);
          if (first.empty()) first = by_features;
          CHECK(by_features == first);
        }
      }
    }
  });
}

TEST_CASE_TEMPLATE("the gradient by the points, along a direction, is the derivative along it", T, float, double) {
  test::for_each_instruction_set([] {
    for (const Encoding encoding : {Encoding::kTriQuadtree, Encoding::kOctree}) {
      const Scene<T> scene(encoding);
      std::vector<T> along(kStride * kPoints), by_points(3 * kPoints);
      interpolate(scene.table, scene.features.data(), scene.batch(true), along.data(), kStride, 1);
      coordinate_gradient(scene.table, scene.features.data(), scene.batch(false), scene.grad.data(), kStride,
                          by_points.data(), 2);
      for (std::size_t n = 0; n < kPoints; ++n) {
        double left = 0, right = 0, scale = 1;
        for (std::size_t i = 0; i < 3; ++i) {
          left += static_cast<double>(by_points[3 * n + i]) * static_cast<double>(scene.directions[3 * n + i]);
        }
        for (std::size_t i = n * kStride; i < (n + 1) * kStride; ++i) {
          right += static_cast<double>(along[i]) * static_cast<double>(scene.grad[i]);
          scale += std::abs(static_cast<double>(along[i]) * static_cast<double>(scene.grad[i]));
        }
        REQUIRE(std::abs(left - right) < 5 * kTolerance<T> * scale);
      }
    }
  });
}

TEST_CASE_TEMPLATE("Fourier features are sine and cosine", T, float, double) {
  constexpr int kFirst = 1, kCount = 8;
  const double pi = std::acos(-1.0), half_width_m = 64;  // a power of two: angles are exact
  const auto points = test::normal_numbers<T>(3 * kPoints, 20, 6);
  std::vector<double> expected(6 * kCount * kPoints);
  for (std::size_t n = 0; n < kPoints; ++n) {
    for (std::size_t k = 0; k < kCount; ++k) {
      for (std::size_t axis = 0; axis < 3; ++axis) {
        // The turns of a whole period are taken off first.
        const double t = std::remainder(
            std::ldexp(static_cast<double>(points[3 * n + axis]), kFirst + static_cast<int>(k)) / half_width_m, 2.0);
        expected[6 * kCount * n + 3 * k + axis] = std::sin(pi * t);
        expected[6 * kCount * n + 3 * (kCount + k) + axis] = std::cos(pi * t);
      }
    }
  }
  test::for_each_instruction_set([&] {
    std::vector<T> out(expected.size());
    fourier(points.data(), kPoints, half_width_m, kFirst, kCount, out.data(), 6 * kCount, 2);
    check_close(out, expected, sizeof(T) == 4 ? 1e-6 : 1e-15);
  });
}

TEST_CASE_TEMPLATE("products of matrices, with what comes before and after", T, float, double) {
  constexpr std::int64_t kRows = 13, kDepth = 9, kColumns = 3 * kColumnBlock;
  const auto a = test::normal_numbers<T>(kRows * kDepth, 1, 7), b = test::normal_numbers<T>(kDepth * kColumns, 1, 8);
  const auto start = test::normal_numbers<T>(kRows * kColumns, 1, 9), biases = test::normal_numbers<T>(kColumns, 1, 10);
  const auto positive = test::normal_numbers<T>(kRows * kColumns, 1, 11);
  test::for_each_instruction_set([&] {
    for (int way = 0; way < 12; ++way) {
      const bool transposed = way % 2 == 1, adds = way / 2 % 3 == 1, has_biases = way / 2 % 3 == 2;
      const bool rectify = way >= 6, masks = !rectify && adds;
      std::vector<T> c = start;
      Product<T> p{};
      p.a = a.data();
      p.a_row = transposed ? 1 : kDepth;
      p.a_depth = transposed ? kRows : 1;
      p.b = b.data();
      p.b_row = p.columns = p.c_row = p.positive_row = kColumns;
      p.c = c.data();
      p.rows = kRows;
      p.depth = kDepth;
      p.add = adds;
      p.biases = has_biases ? biases.data() : nullptr;
      p.rectify = rectify;
      p.positive = masks ? positive.data() : nullptr;
      RADARSDF_KERNEL(product_kernel<T>)().multiply(p);
      std::vector<double> expected;
      for (std::int64_t r = 0; r < kRows; ++r) {
        for (std::int64_t n = 0; n < kColumns; ++n) {
          const auto at = static_cast<std::size_t>(r * kColumns + n);
          double sum = static_cast<double>(adds ? start[at] : has_biases ? biases[static_cast<std::size_t>(n)] : T(0));
          for (std::int64_t k = 0; k < kDepth; ++k) {
            sum += static_cast<double>(a[static_cast<std::size_t>(r * p.a_row + k * p.a_depth)]) *
                   static_cast<double>(b[static_cast<std::size_t>(k * kColumns + n)]);
          }
          if (rectify) sum = std::max(sum, 0.0);
          if (masks && !(positive[at] > 0)) sum = 0;
          expected.push_back(sum);
        }
      }
      check_close(c, expected, kTolerance<T>);
    }
  });
}

TEST_CASE("Adam on the touched rows is Adam, but that rows without a gradient stay") {
  const double rate = 0.01, epsilon = 1e-8, betas[2] = {0.9, 0.99};
  constexpr int kSteps = 4;
  test::for_each_instruction_set([&] {
    for (const Encoding encoding : {Encoding::kTriQuadtree, Encoding::kOctree}) {
      const Scene<double> scene(encoding);
      std::vector<double> features = scene.features, expected = scene.features;
      std::vector<double> moments(2 * features.size()), mean(features.size()), square(features.size());
      std::vector<RowMark> marks(features.size() / kFeatureDim);
      std::vector<double> decays;
      for (int n = 0; n <= kSteps; ++n) decays.insert(decays.end(), {std::pow(betas[0], n), std::pow(betas[1], n)});
      for (std::int32_t step = 1; step <= kSteps; ++step) {
        // Another part of the points in each step, in two batches.
        const std::int64_t first = 100 * step, half = 150;
        const auto part = [&](std::int64_t begin) {
          return PointBatch<double>{scene.points.data() + 3 * begin, nullptr, scene.located.data() + kLevels * begin,
                                    half};
        };
        const double* grads[2] = {scene.grad.data() + kStride * first, scene.grad.data() + kStride * (first + half)};
        const AdamStep<double> adam{features.data(),
                                    moments.data(),
                                    marks.data(),
                                    decays.data(),
                                    step,
                                    rate / (1 - std::pow(betas[0], step)),
                                    1 / (1 - std::pow(betas[1], step)),
                                    epsilon};
        Crew(2).run(num_level_tasks(scene.table), [&](std::int64_t task) {
          adam_task(scene.table, {part(first), part(first + half)}, {grads[0], grads[1]}, {kStride, kStride}, adam,
                    level_task(scene.table, task));
        });

        std::vector<double> by_features(features.size()), touches(features.size());
        const std::vector<double> ones(scene.grad.size(), 1);
        for (int b = 0; b < 2; ++b) {
          scatter(scene.table, part(first + b * half), grads[b], kStride, by_features.data(), 1);
          scatter(scene.table, part(first + b * half), ones.data(), kStride, touches.data(), 1);
        }
        for (std::size_t i = 0; i < features.size(); ++i) {
          mean[i] = betas[0] * mean[i] + (1 - betas[0]) * by_features[i];
          square[i] = betas[1] * square[i] + (1 - betas[1]) * by_features[i] * by_features[i];
          if (touches[i] == 0) continue;
          expected[i] -= rate / (1 - std::pow(betas[0], step)) * mean[i] /
                         (std::sqrt(square[i] / (1 - std::pow(betas[1], step))) + epsilon);
        }
      }
      CHECK(features != scene.features);
      for (std::size_t i = 0; i < features.size(); ++i) REQUIRE(std::abs(features[i] - expected[i]) < 1e-9);
    }
  });
}

}  // namespace
}  // namespace radarsdf
