// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>
#include <utility>
#include <vector>

#include "helpers.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/cell_walk.hpp"
#include "lattice/morton.hpp"
#include "returns/cell_sums.hpp"
#include "returns/looks.hpp"
#include "returns/principal_axes.hpp"
#include "returns/ray_average.hpp"
#include "returns/smooth_distances.hpp"
#include "returns/surface_crossings.hpp"

namespace {

std::uint64_t key_of(std::int32_t x, std::int32_t y, std::int32_t z) {
  const std::int32_t cell[3] = {x, y, z};
  return radarsdf::lattice_key(cell);
}

// The cells of some points, and the row of each point's.
struct Cells {
  std::vector<std::uint64_t> keys;  // ascending
  std::vector<std::int32_t> rows;
};

Cells cells_of(const std::vector<float>& points, double size_m) {
  const auto count = static_cast<std::int64_t>(points.size()) / 3;
  std::vector<std::uint64_t> keys(static_cast<std::size_t>(count));
  radarsdf::cell_keys(points.data(), count, size_m, keys.data(), 1);
  Cells cells{keys, {}};
  std::sort(cells.keys.begin(), cells.keys.end());
  cells.keys.erase(std::unique(cells.keys.begin(), cells.keys.end()), cells.keys.end());
  for (const std::uint64_t key : keys) {
    const auto place = std::lower_bound(cells.keys.begin(), cells.keys.end(), key);
    cells.rows.push_back(static_cast<std::int32_t>(place - cells.keys.begin()));
  }
  return cells;
}

}  // namespace

TEST_CASE("principal axes of a diagonal matrix") {
  const double matrices[2][9] = {{3, 0, 0, 0, 1, 0, 0, 0, 2}, {0, 0, 0, 0, 0, 0, 0, 0, 0}};
  double values[6], vectors[18];
  radarsdf::principal_axes(matrices[0], 2, values, vectors, 1);
  for (int k = 0; k < 3; ++k) {
    CHECK(values[k] == k + 1);
    CHECK(values[3 + k] == 0);
  }
  const int axes[3] = {1, 2, 0};  // of the values in ascending order
  for (int k = 0; k < 3; ++k) {
    for (int i = 0; i < 3; ++i) CHECK(std::abs(vectors[3 * i + k]) == (i == axes[k] ? 1 : 0));
  }
}

TEST_CASE("principal axes rebuild their matrices") {
  constexpr std::size_t kCount = 3000;
  const auto numbers = test::normal_numbers<double>(9 * kCount, 1, 1);
  std::vector<double> matrices;
  for (std::size_t m = 0; m < kCount; ++m) {
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        const double symmetric = numbers[9 * m + 3 * i + j] + numbers[9 * m + 3 * j + i];
        matrices.push_back(symmetric * std::pow(10.0, static_cast<double>(m % 21) - 10));
      }
    }
  }
  matrices[9] = std::numeric_limits<double>::quiet_NaN();
  std::vector<double> first;
  for (const int threads : test::kThreads) {
    std::vector<double> values(3 * kCount), vectors(9 * kCount);
    radarsdf::principal_axes(matrices.data(), kCount, values.data(), vectors.data(), threads);
    CHECK(std::isnan(values[3]));
    CHECK(std::isnan(vectors[9]));
    values.erase(values.begin() + 3, values.begin() + 6);  // NaN equals nothing
    if (first.empty()) first = values;
    CHECK(values == first);
    values.insert(values.begin() + 3, 3, 0.0);
    for (std::size_t m = 0; m < kCount; ++m) {
      if (m == 1) continue;
      const double *w = &values[3 * m], *v = &vectors[9 * m], *a = &matrices[9 * m];
      REQUIRE(w[0] <= w[1]);
      REQUIRE(w[1] <= w[2]);
      const double scale = std::max(std::abs(w[0]), std::abs(w[2]));
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
          double rebuilt = 0, product = 0;
          for (int k = 0; k < 3; ++k) {
            rebuilt += w[k] * v[3 * i + k] * v[3 * j + k];
            product += v[3 * k + i] * v[3 * k + j];
          }
          REQUIRE(std::abs(rebuilt - a[3 * i + j]) < 1e-13 * scale);
          REQUIRE(std::abs(product - (i == j)) < 1e-13);
        }
      }
    }
  }
}

TEST_CASE("rays cross a plane where they end behind it") {
  constexpr float kCell = 0.5F;
  // Surfels on the plane z = 0.1, towards sensors above it, one in each cell of 40 x 40.
  std::map<std::uint64_t, radarsdf::Surfel> by_key;
  for (int x = -20; x < 20; ++x) {
    for (int y = -20; y < 20; ++y) {
      const float centre[2] = {(static_cast<float>(x) + 0.5F) * kCell, (static_cast<float>(y) + 0.5F) * kCell};
      by_key[key_of(x, y, 0)] = {{centre[0], centre[1], 0.1F}, {0, 0, 1}, 0.01F, 1.0F};
    }
  }
  std::vector<std::uint64_t> keys;
  std::vector<radarsdf::Surfel> surfels;
  for (const auto& [key, surfel] : by_key) {
    keys.push_back(key);
    surfels.push_back(surfel);
  }
  const radarsdf::SurfelMap map(keys.data(), surfels.data(), static_cast<std::int64_t>(keys.size()), kCell);

  constexpr std::size_t kRays = 2000;
  const auto numbers = test::normal_numbers<float>(3 * kRays, 1, 2);
  std::vector<float> points, directions, ranges;
  std::vector<bool> expected;
  std::vector<std::array<double, 2>> places;
  for (std::size_t i = 0; i < kRays; ++i) {
    // From 3 m above the plane, down or, each fourth, up from as far below: those meet the surfels from behind.
    const bool up = i % 4 == 3;
    const float sensor[3] = {numbers[3 * i], numbers[3 * i + 1], up ? -2.9F : 3.1F};
    const float slope = 0.4F * numbers[3 * i + 2] / 3;
    const float length = std::sqrt(1 + slope * slope);
    const float direction[3] = {slope / length, 0, (up ? 1.0F : -1.0F) / length};
    const float depth = i % 2 == 0 ? 1.0F : -0.3F;  // of the end, behind the plane
    const float range = (3.0F + (up ? 1.0F : depth)) * length;
    for (int axis = 0; axis < 3; ++axis) {
      points.push_back(sensor[axis] + range * direction[axis]);
      directions.push_back(direction[axis]);
    }
    ranges.push_back(range);
    expected.push_back(!up && depth > 0);
    places.push_back({double{sensor[0]} + 3.0 * slope, double{sensor[1]}});
  }
  for (const int threads : test::kThreads) {
    std::vector<std::int32_t> crossed(kRays);
    map.first_crossings(points.data(), directions.data(), ranges.data(), kRays, {0.02F, 0.001F}, 0.1F, 3,
                        crossed.data(), threads);
    for (std::size_t i = 0; i < kRays; ++i) {
      REQUIRE((crossed[i] >= 0) == expected[i]);
      if (crossed[i] < 0) continue;
      const radarsdf::Surfel& surfel = surfels[static_cast<std::size_t>(crossed[i])];
      // In the cell where the ray meets the plane, or, by the slack, in a neighbour.
      for (std::size_t axis = 0; axis < 2; ++axis) {
        REQUIRE(std::abs(static_cast<double>(surfel.centre[axis]) - places[i][axis]) < 0.8 * kCell);
      }
    }
    // With a margin larger than the depth of any end, no ray crosses.
    map.first_crossings(points.data(), directions.data(), ranges.data(), kRays, {0.02F, 0.001F}, 1.5F, 3,
                        crossed.data(), threads);
    CHECK(std::all_of(crossed.begin(), crossed.end(), [](std::int32_t c) { return c == -1; }));
  }
  CHECK_THROWS_AS(radarsdf::SurfelMap(keys.data(), surfels.data(), 2, 0), std::invalid_argument);
}

TEST_CASE("sums over the returns of a cell do not depend on their order") {
  constexpr std::int64_t kCount = 40000;
  constexpr double kQuantum = 0.001;
  auto points = test::normal_numbers<float>(3 * kCount, 2, 3);
  auto directions = test::unit_vectors<float>(kCount, 4);
  Cells cells = cells_of(points, 0.5);
  const auto num_cells = static_cast<std::int64_t>(cells.keys.size());
  std::vector<float> ranges(kCount);
  for (std::size_t i = 0; i < kCount; ++i) ranges[i] = 5 + points[3 * i];
  std::vector<std::int64_t> corners(static_cast<std::size_t>(3 * num_cells));
  for (std::size_t i = 0; i < corners.size(); ++i) corners[i] = static_cast<std::int64_t>(i % 7) * 500 - 1500;
  std::vector<std::int64_t> expected(static_cast<std::size_t>(radarsdf::kSums * num_cells));
  for (std::size_t i = 0; i < kCount; ++i) {
    const auto cell = static_cast<std::size_t>(cells.rows[i]);
    std::int64_t at[3], along[3];
    for (std::size_t axis = 0; axis < 3; ++axis) {
      at[axis] = std::llrint(points[3 * i + axis] * (1 / kQuantum)) - corners[3 * cell + axis];
      along[axis] = std::llrint(directions[3 * i + axis] * radarsdf::kDirectionQuanta);
    }
    const std::int64_t range = std::llrint(ranges[i] * (1 / kQuantum));
    const std::int64_t terms[] = {1,
                                  at[0],
                                  at[1],
                                  at[2],
                                  at[0] * at[0],
                                  at[0] * at[1],
                                  at[0] * at[2],
                                  at[1] * at[1],
                                  at[1] * at[2],
                                  at[2] * at[2],
                                  along[0],
                                  along[1],
                                  along[2],
                                  range};
    for (std::size_t k = 0; k < radarsdf::kSums; ++k) expected[radarsdf::kSums * cell + k] += terms[k];
  }
  const auto sums = [&](int threads) {
    std::vector<std::int64_t> found(expected.size(), -1);
    radarsdf::sum_returns({points.data(), directions.data(), ranges.data(), cells.rows.data(), kCount}, corners.data(),
                          num_cells, kQuantum, found.data(), threads);
    return found;
  };
  for (const int threads : test::kThreads) CHECK(sums(threads) == expected);
  std::reverse(cells.rows.begin(), cells.rows.end());
  std::reverse(ranges.begin(), ranges.end());
  for (std::vector<float>* vectors : {&points, &directions}) {
    std::reverse(vectors->begin(), vectors->end());
    for (std::size_t i = 0; i < kCount; ++i) std::swap((*vectors)[3 * i], (*vectors)[3 * i + 2]);
  }
  CHECK(sums(2) == expected);
}

TEST_CASE("sums round a cell are those of its 27 cells") {
  const auto points = test::normal_numbers<float>(3 * 3000, 1.5, 5);
  const Cells cells = cells_of(points, 0.25);
  const auto num_cells = static_cast<std::int64_t>(cells.keys.size());
  constexpr int kColumns = 2;
  const auto values = test::normal_numbers<double>(kColumns * num_cells, 1, 6);
  const radarsdf::CellBlocks blocks(cells.keys.data(), num_cells);
  for (const double weight : {1.0, 0.5}) {
    std::vector<double> expected;
    for (const std::uint64_t key : cells.keys) {
      std::array<double, kColumns> sums{};
      for (int n = 0; n < 27; ++n) {
        const int step[3] = {n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1};
        std::uint32_t at[3];
        int differing = 0;
        for (int axis = 0; axis < 3; ++axis) {
          at[axis] = radarsdf::morton_coordinate(key, axis) + static_cast<std::uint32_t>(step[axis]);
          differing += step[axis] != 0;
        }
        const std::uint64_t other = radarsdf::morton_key(at[0], at[1], at[2]);
        const auto place = std::lower_bound(cells.keys.begin(), cells.keys.end(), other);
        if (place == cells.keys.end() || *place != other) continue;
        for (std::size_t k = 0; k < kColumns; ++k) {
          sums[k] +=
              std::pow(weight, differing) * values[kColumns * static_cast<std::size_t>(place - cells.keys.begin()) + k];
        }
      }
      expected.insert(expected.end(), sums.begin(), sums.end());
    }
    std::vector<double> first;
    for (const int threads : test::kThreads) {
      std::vector<double> sums(expected.size());
      radarsdf::sum_round(blocks, cells.keys.data(), num_cells, values.data(), kColumns, weight, sums.data(), threads);
      for (std::size_t i = 0; i < sums.size(); ++i) REQUIRE(std::abs(sums[i] - expected[i]) < 1e-12);
      if (first.empty()) first = sums;
      CHECK(sums == first);
    }
  }
}

TEST_CASE("a linear function of the cells' centres is interpolated exactly") {
  constexpr double kSize = 0.25;
  std::vector<std::uint64_t> keys;
  for (int x = -8; x < 8; ++x) {
    for (int y = -8; y < 8; ++y) {
      for (int z = -8; z < 8; ++z) keys.push_back(key_of(x, y, z));
    }
  }
  std::sort(keys.begin(), keys.end());
  const auto linear = [](double x, double y, double z) { return 0.5 + 2 * x - y + 3 * z; };
  std::vector<float> values;
  for (const std::uint64_t key : keys) {
    double at[3];
    for (int axis = 0; axis < 3; ++axis) {
      at[axis] = (static_cast<double>(radarsdf::morton_coordinate(key, axis)) - radarsdf::kAxisBias + 0.5) * kSize;
    }
    values.push_back(static_cast<float>(linear(at[0], at[1], at[2])));
  }
  const radarsdf::CellBlocks blocks(keys.data(), static_cast<std::int64_t>(keys.size()));
  std::vector<float> points = test::normal_numbers<float>(3 * 500, 1, 7);
  for (float& v : points) v = std::clamp(v, -1.8F, 1.8F);
  std::vector<float> found(500);
  radarsdf::interpolate_cells(blocks, kSize, values.data(), 1, points.data(), 500, found.data(), 2);
  for (std::size_t i = 0; i < 500; ++i) {
    const double expected = linear(points[3 * i], points[3 * i + 1], points[3 * i + 2]);
    REQUIRE(static_cast<double>(found[i]) == doctest::Approx(expected).epsilon(1e-5));
  }
  const float outside[3] = {10, 0, 0};
  radarsdf::interpolate_cells(blocks, kSize, values.data(), 1, outside, 1, found.data(), 1);
  CHECK(found[0] == 0);
  const float bad[3] = {std::numeric_limits<float>::quiet_NaN(), 0, 0};
  CHECK_THROWS_AS(radarsdf::interpolate_cells(blocks, kSize, values.data(), 1, bad, 1, found.data(), 1),
                  std::invalid_argument);
}

TEST_CASE("rays that meet a plane straight average to its distance, cut at the truncation") {
  constexpr std::int64_t kRays = 20000;
  constexpr double kSize = 0.25, kTruncation = 0.6;
  constexpr float kHeight = 0.07F;
  std::vector<float> points = test::normal_numbers<float>(3 * kRays, 1, 8), directions, normals;
  std::vector<float> weights(kRays, 2.0F);
  for (std::size_t i = 0; i < kRays; ++i) {
    points[3 * i + 2] = kHeight;
    directions.insert(directions.end(), {0, 0, -1});
    normals.insert(normals.end(), {0, 0, 1});
  }
  radarsdf::CellSet cells(kSize);
  cells.insert_rays(points.data(), directions.data(), kRays, kTruncation, 1);
  const radarsdf::VertexTable table(cells.sorted_keys(1), kSize, 1, radarsdf::Encoding::kOctree, 1);
  const auto vertices = radarsdf::leaf_vertices(table);
  for (const int threads : test::kThreads) {
    std::vector<float> distances(static_cast<std::size_t>(table.num_rows()));
    std::vector<std::int8_t> sides(distances.size());
    radarsdf::average_rays(table, {points.data(), directions.data(), normals.data(), weights.data(), kRays},
                           kTruncation, distances.data(), sides.data(), threads);
    for (std::size_t row = 0; row < distances.size(); ++row) {
      const double z = vertices.coordinates[3 * row + 2] * kSize - static_cast<double>(kHeight);
      REQUIRE(static_cast<double>(distances[row]) ==
              doctest::Approx(std::clamp(z, -kTruncation, kTruncation)).epsilon(1e-4));
    }
  }
  // What agrees with the planes already stays, but for rounding, where the truncation bends nothing.
  for (const int threads : test::kThreads) {
    std::vector<float> distances(static_cast<std::size_t>(table.num_rows()));
    for (std::size_t row = 0; row < distances.size(); ++row)
      distances[row] = static_cast<float>(vertices.coordinates[3 * row + 2] * kSize) - kHeight;
    const std::vector<std::int8_t> unknown(distances.size());
    radarsdf::smooth_distances(table, {points.data(), normals.data(), weights.data(), kRays}, unknown.data(), 5,
                               distances.data(), threads);
    for (std::size_t row = 0; row < distances.size(); ++row) {
      const double z = vertices.coordinates[3 * row + 2] * kSize - static_cast<double>(kHeight);
      REQUIRE(static_cast<double>(distances[row]) == doctest::Approx(z).epsilon(1e-4));
    }
  }
  const radarsdf::VertexTable planes(cells.sorted_keys(1), kSize, 1, radarsdf::Encoding::kTriQuadtree, 1);
  float none = 0;
  std::int8_t side = 0;
  CHECK_THROWS_AS(radarsdf::smooth_distances(planes, {nullptr, nullptr, nullptr, 0}, &side, 1, &none, 1),
                  std::invalid_argument);
  CHECK_THROWS_AS(radarsdf::average_rays(planes, {nullptr, nullptr, nullptr, nullptr, 0}, kTruncation, &none, &side, 1),
                  std::invalid_argument);
}

TEST_CASE("a scan looks once at each cube that one of its rays goes through") {
  constexpr std::size_t kRays = 20000;
  constexpr double kSize = 0.25, kCube = 8 * kSize;
  auto points = test::normal_numbers<float>(3 * kRays, 4, 9);
  auto directions = test::unit_vectors<float>(kRays, 10);
  auto ranges = test::normal_numbers<float>(kRays, 4, 11);
  std::vector<std::int32_t> scans;
  for (std::size_t i = 0; i < kRays; ++i) {
    ranges[i] = std::abs(ranges[i]);
    // Two thirds of the rays, all alike, are of one scan: more than a thread's share.
    scans.push_back(static_cast<std::int32_t>(std::min(i, kRays / 3)));
    if (i <= kRays / 3) continue;
    ranges[i] = ranges[kRays / 3];
    for (std::size_t axis = 0; axis < 3; ++axis) {
      points[3 * i + axis] = points[kRays / 3 * 3 + axis];
      directions[3 * i + axis] = directions[kRays / 3 * 3 + axis];
    }
  }
  const Cells cells = cells_of(test::normal_numbers<float>(3 * 300, 4, 12), kSize);
  std::vector<std::uint32_t> expected;
  for (const std::uint64_t key : cells.keys) {
    std::set<std::int32_t> looked;
    for (std::size_t i = 0; i < kRays; ++i) {
      double begin = -double{ranges[i]}, end = 0;  // of the ray in the cube
      for (std::size_t axis = 0; axis < 3; ++axis) {
        const std::int64_t cell = radarsdf::morton_coordinate(key, static_cast<int>(axis));
        const double low = static_cast<double>((cell >> 3) - (radarsdf::kAxisBias >> 3)) * kCube;
        const double at = points[3 * i + axis], speed = directions[3 * i + axis];
        begin = std::max(begin, std::min((low - at) / speed, (low + kCube - at) / speed));
        end = std::min(end, std::max((low - at) / speed, (low + kCube - at) / speed));
      }
      if (begin <= end) looked.insert(scans[i]);
    }
    expected.push_back(static_cast<std::uint32_t>(looked.size()));
  }
  CHECK(*std::min_element(expected.begin(), expected.end()) == 0);
  CHECK(*std::max_element(expected.begin(), expected.end()) > 20);
  const auto num_cells = static_cast<std::int64_t>(cells.keys.size());
  const auto count = [&](std::vector<std::uint32_t>& looks, int threads) {
    radarsdf::count_looks(cells.keys.data(), num_cells, kSize, points.data(), directions.data(), ranges.data(),
                          scans.data(), kRays, looks.data(), threads);
  };
  std::vector<std::uint32_t> looks(expected.size());
  for (const int threads : test::kThreads) {
    std::fill(looks.begin(), looks.end(), 77U);
    count(looks, threads);
    CHECK(looks == expected);
  }
  ranges[7] = -1;
  CHECK_THROWS_AS(count(looks, 1), std::invalid_argument);
  ranges[7] = std::numeric_limits<float>::quiet_NaN();
  CHECK_THROWS_AS(count(looks, 1), std::invalid_argument);
  ranges[7] = 600000;  // the point is near, the sensor too far away
  CHECK_THROWS_AS(count(looks, 1), std::invalid_argument);
  ranges[7] = 1;
  std::swap(scans.front(), scans.back());
  CHECK_THROWS_AS(count(looks, 1), std::invalid_argument);
}

TEST_CASE("the scans of a cell are counted once each") {
  constexpr std::size_t kCount = 40000;
  const Cells cells = cells_of(test::normal_numbers<float>(3 * kCount, 1, 13), 0.5);
  std::vector<std::int32_t> scans;
  for (std::size_t i = 0; i < kCount; ++i) scans.push_back(static_cast<std::int32_t>(i < kCount / 2 ? i / 90 : 500));
  std::set<std::pair<std::int32_t, std::int32_t>> pairs;
  for (std::size_t i = 0; i < kCount; ++i) pairs.insert({cells.rows[i], scans[i]});
  std::vector<std::uint32_t> expected(cells.keys.size() + 1);  // the last cell has no returns
  for (const auto& [cell, scan] : pairs) ++expected[static_cast<std::size_t>(cell)];
  const auto num_cells = static_cast<std::int64_t>(expected.size());
  for (const int threads : test::kThreads) {
    std::vector<std::uint32_t> counts(expected.size(), 77);
    radarsdf::count_scans(cells.rows.data(), scans.data(), kCount, num_cells, counts.data(), threads);
    CHECK(counts == expected);
  }
  std::uint32_t none = 77;
  radarsdf::count_scans(nullptr, nullptr, 0, 1, &none, 2);
  CHECK(none == 0);
  std::swap(scans.front(), scans.back());
  CHECK_THROWS_AS(radarsdf::count_scans(cells.rows.data(), scans.data(), kCount, num_cells, expected.data(), 1),
                  std::invalid_argument);
}
