// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <set>
#include <stdexcept>
#include <vector>

#include "helpers.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/cell_walk.hpp"
#include "lattice/flat_map.hpp"
#include "lattice/morton.hpp"
#include "lattice/vertex_table.hpp"

using radarsdf::kAxisBias;
using LatticeCell = std::array<std::int32_t, 3>;

namespace {

std::uint64_t key_of(const LatticeCell& cell) { return radarsdf::lattice_key(cell.data()); }

LatticeCell cell_of(std::uint64_t key) {
  LatticeCell cell;
  for (int axis = 0; axis < 3; ++axis) {
    cell[static_cast<std::size_t>(axis)] =
        static_cast<std::int32_t>(radarsdf::morton_coordinate(key, axis)) - kAxisBias;
  }
  return cell;
}

LatticeCell floor_of(const double* point, double size_m) {
  return {static_cast<std::int32_t>(std::floor(point[0] / size_m)),
          static_cast<std::int32_t>(std::floor(point[1] / size_m)),
          static_cast<std::int32_t>(std::floor(point[2] / size_m))};
}

std::set<std::uint64_t> random_keys(int count, double spread, unsigned seed) {
  const auto numbers = test::normal_numbers<double>(3 * count, spread, seed);
  std::set<std::uint64_t> keys;
  for (std::size_t i = 0; i < numbers.size(); i += 3) keys.insert(key_of(floor_of(&numbers[i], 1)));
  return keys;
}

}  // namespace

TEST_CASE("a Morton key gives its coordinates back, and shifted its parent's") {
  std::mt19937 generator(1);
  constexpr std::uint32_t kLast = (1u << radarsdf::kAxisBits) - 1;
  for (int i = 0; i < 10000; ++i) {
    std::array<std::uint32_t, 3> c{};
    for (std::uint32_t& v : c) v = i == 0 ? 0 : i == 1 ? kLast : generator() & kLast;
    const std::uint64_t key = radarsdf::morton_key(c[0], c[1], c[2]);
    REQUIRE((key >> 63) == 0);
    for (int axis = 0; axis < 3; ++axis) {
      REQUIRE(radarsdf::morton_coordinate(key, axis) == c[static_cast<std::size_t>(axis)]);
    }
    REQUIRE((key >> 3) == radarsdf::morton_key(c[0] >> 1, c[1] >> 1, c[2] >> 1));
    REQUIRE((key & 7) == ((c[0] & 1) | (c[1] & 1) << 1 | (c[2] & 1) << 2));
  }
}

TEST_CASE("the flat map is a map") {
  std::mt19937_64 generator(2);
  std::vector<std::uint64_t> keys(16000);  // random: the hash gives each of consecutive numbers a place of its own
  for (std::uint64_t& key : keys) key = generator() >> 1;
  std::map<std::uint64_t, std::int32_t> expected;
  radarsdf::FlatMap map;
  for (std::int32_t i = 0; i < 20000; ++i) {
    const std::uint64_t key = keys[generator() % 15000];
    CHECK(map.insert(key, i) == expected.insert({key, i}).second);
  }
  CHECK(map.size() == expected.size());
  for (const std::uint64_t key : keys) {
    const auto found = expected.find(key);
    REQUIRE(map.find(key) == (found == expected.end() ? -1 : found->second));
  }
  for (std::int32_t i = 0; i < 40000; ++i) {  // comes and goes: what is left is found, wherever it was moved to
    const std::uint64_t key = keys[generator() % 15000];
    if (generator() % 3 == 0) {
      CHECK(map.insert(key, i) == expected.insert({key, i}).second);
    } else {
      CHECK(map.erase(key) == (expected.erase(key) == 1));
    }
  }
  CHECK(map.size() == expected.size());
  for (const std::uint64_t key : keys) {
    const auto found = expected.find(key);
    REQUIRE(map.find(key) == (found == expected.end() ? -1 : found->second));
  }
}

TEST_CASE_TEMPLATE("the cell set is the set of the points' cells", T, float, double) {
  constexpr std::int64_t kPoints = 30000;
  constexpr double kSize = 0.25;  // a power of two: float and double agree on the cell of a point
  const auto points = test::normal_numbers<T>(3 * kPoints, 3, 3);
  std::set<std::uint64_t> expected;
  for (std::size_t i = 0; i < points.size(); i += 3) {
    const double point[] = {points[i], points[i + 1], points[i + 2]};
    expected.insert(key_of(floor_of(point, kSize)));
  }
  for (const int threads : test::kThreads) {
    radarsdf::CellSet cells(kSize);
    cells.insert(points.data() + 3 * 10000, kPoints - 10000, threads);
    cells.insert(points.data(), 20000, threads);  // out of order, and some of them twice
    CHECK(cells.size() == static_cast<std::int64_t>(expected.size()));
    CHECK(cells.sorted_keys(threads) == std::vector<std::uint64_t>(expected.begin(), expected.end()));
  }
}

TEST_CASE("a point that has no cell is refused before anything is stored") {
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), -2e6F}) {
    const float points[] = {0, 0, 0, 0, bad, 0};
    radarsdf::CellSet cells(1.0);
    CHECK_THROWS_AS(cells.insert(points, 2, 1), std::invalid_argument);
    CHECK(cells.size() == 0);
  }
  CHECK_THROWS_AS(radarsdf::CellSet(0.0), std::invalid_argument);
  CHECK_THROWS_AS(radarsdf::CellSet(std::nan("")), std::invalid_argument);
}

TEST_CASE("rays mark the cells that they go through, and no others") {
  constexpr std::int64_t kRays = 200;
  constexpr double kSize = 0.5, kReach = 3;
  const auto points = test::normal_numbers<float>(3 * kRays, 4, 4);
  const auto directions = test::unit_vectors<float>(kRays, 5);
  std::vector<std::uint64_t> first;
  for (const int threads : test::kThreads) {
    radarsdf::CellSet cells(kSize);
    cells.insert_rays(points.data(), directions.data(), kRays, kReach, threads);
    const auto keys = cells.sorted_keys(threads);
    if (first.empty()) first = keys;
    CHECK(keys == first);
  }
  const std::set<std::uint64_t> found(first.begin(), first.end());
  std::set<std::uint64_t> seen;
  for (std::size_t i = 0; i < kRays; ++i) {
    for (int step = -3000; step <= 3000; ++step) {
      double at[3];
      bool near_face = false;  // there, rounding decides between two cells
      for (std::size_t axis = 0; axis < 3; ++axis) {
        at[axis] = points[3 * i + axis] + kReach * step / 3000 * directions[3 * i + axis];
        near_face = near_face || std::abs(at[axis] / kSize - std::round(at[axis] / kSize)) < 1e-4;
      }
      if (!near_face) {
        const std::uint64_t key = key_of(floor_of(at, kSize));
        REQUIRE(found.count(key) == 1);
        seen.insert(key);
      }
    }
  }
  // Samples a millimetre apart miss cells of which a ray cuts a corner only.
  CHECK(seen.size() > 0.98 * static_cast<double>(found.size()));
}

TEST_CASE("blocks find the row of a key") {
  const std::set<std::uint64_t> set = random_keys(5000, 12, 6);
  const std::vector<std::uint64_t> keys(set.begin(), set.end());
  const radarsdf::CellBlocks blocks(keys.data(), static_cast<std::int64_t>(keys.size()));
  const std::set<std::uint64_t> others = random_keys(5000, 14, 7);
  std::vector<std::uint64_t> asked(others.begin(), others.end());
  asked.insert(asked.end(), keys.begin(), keys.end());
  for (const int threads : test::kThreads) {
    std::vector<std::int32_t> rows(asked.size());
    blocks.rows(asked.data(), static_cast<std::int64_t>(asked.size()), rows.data(), threads);
    for (std::size_t i = 0; i < asked.size(); ++i) {
      const auto place = std::lower_bound(keys.begin(), keys.end(), asked[i]);
      const bool there = place != keys.end() && *place == asked[i];
      REQUIRE(rows[i] == (there ? static_cast<std::int32_t>(place - keys.begin()) : -1));
    }
  }
  const std::uint64_t unsorted[] = {5, 4}, twice[] = {5, 5};
  CHECK_THROWS_AS(radarsdf::CellBlocks(unsorted, 2), std::invalid_argument);
  CHECK_THROWS_AS(radarsdf::CellBlocks(twice, 2), std::invalid_argument);
}

TEST_CASE("the table numbers the vertices of each level and group in Morton order") {
  constexpr int kLevels = 3;
  const std::set<std::uint64_t> set = random_keys(1500, 6, 8);
  const std::vector<std::uint64_t> leaves(set.begin(), set.end());
  for (const auto encoding : {radarsdf::Encoding::kTriQuadtree, radarsdf::Encoding::kOctree}) {
    const int groups = radarsdf::num_vertex_groups(encoding), corners = radarsdf::corners_per_group(encoding);
    const std::vector<std::vector<int>> axes =
        groups == 1 ? std::vector<std::vector<int>>{{0, 1, 2}} : std::vector<std::vector<int>>{{0, 1}, {0, 2}, {1, 2}};
    for (const int threads : test::kThreads) {
      const radarsdf::VertexTable table(leaves, 0.5, kLevels, encoding, threads);
      std::int64_t first_row = 0, first_cell = 0;
      std::set<std::uint64_t> keys = set;
      for (int level = 0; level < kLevels; ++level) {
        for (int group = 0; group < groups; ++group) {
          const auto& used = axes[static_cast<std::size_t>(group)];
          // A vertex by its coordinates along the axes that the group uses.
          const auto vertex = [&](std::uint64_t key, int corner) {
            std::uint32_t at[3] = {};
            for (std::size_t i = 0; i < used.size(); ++i) {
              at[used[i]] = radarsdf::morton_coordinate(key, used[i]) + (static_cast<std::uint32_t>(corner) >> i & 1);
            }
            return radarsdf::morton_key(at[0], at[1], at[2]);
          };
          std::set<std::uint64_t> vertices;
          for (const std::uint64_t key : keys) {
            for (int c = 0; c < corners; ++c) vertices.insert(vertex(key, c));
          }
          std::map<std::uint64_t, std::int64_t> row_of;
          for (const std::uint64_t v : vertices) row_of[v] = first_row++;
          std::size_t cell = static_cast<std::size_t>(first_cell);
          for (const std::uint64_t key : keys) {
            for (int c = 0; c < corners; ++c) {
              REQUIRE(table.cells()[cell].rows[group * corners + c] == row_of[vertex(key, c)]);
            }
            ++cell;
          }
        }
        first_cell += static_cast<std::int64_t>(keys.size());
        std::set<std::uint64_t> parents;
        for (const std::uint64_t key : keys) parents.insert(key >> 3);
        keys = parents;
      }
      CHECK(table.num_rows() == first_row);
      CHECK(table.num_cells() == first_cell);
    }
  }
}

TEST_CASE_TEMPLATE("the table locates points as a search of all cells does", T, float, double) {
  constexpr int kLevels = 4;
  constexpr double kSize = 0.5;
  const std::set<std::uint64_t> set = random_keys(1500, 6, 9);
  const radarsdf::VertexTable table({set.begin(), set.end()}, kSize, kLevels, radarsdf::Encoding::kOctree, 1);
  auto points = test::normal_numbers<T>(3 * 5000, 4, 10);
  points[1] = std::numeric_limits<T>::quiet_NaN();
  points[3] = T(1e30);
  std::vector<std::int32_t> located(kLevels * points.size() / 3);
  table.locate(points.data(), static_cast<std::int64_t>(points.size()) / 3, located.data());
  std::vector<std::map<std::uint64_t, std::int32_t>> numbers(kLevels);
  std::set<std::uint64_t> keys = set;
  std::int32_t number = 0;
  for (auto& of_level : numbers) {
    std::set<std::uint64_t> parents;
    for (const std::uint64_t key : keys) {
      of_level[key] = number++;
      parents.insert(key >> 3);
    }
    keys = parents;
  }
  int in_leaves = 0;
  for (std::size_t i = 0; i < points.size() / 3; ++i) {
    const double point[] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    const bool valid = i > 1;
    for (std::size_t level = 0; level < kLevels; ++level) {
      const std::uint64_t key = valid ? key_of(floor_of(point, kSize)) >> (3 * level) : 0;
      const auto found = numbers[level].find(key);
      const std::int32_t expected = valid && found != numbers[level].end() ? found->second : -1;
      REQUIRE(located[kLevels * i + level] == expected);
    }
    in_leaves += located[kLevels * i] >= 0;
  }
  CHECK(in_leaves > 100);
  CHECK(in_leaves < 4900);
}

TEST_CASE("the vertices of leaf cells are their corners") {
  const std::set<std::uint64_t> set = random_keys(500, 5, 11);
  const std::vector<std::uint64_t> leaves(set.begin(), set.end());
  const radarsdf::VertexTable table(leaves, 1, 2, radarsdf::Encoding::kOctree, 1);
  const radarsdf::LeafVertices vertices = radarsdf::leaf_vertices(table);
  const auto coordinates = radarsdf::leaf_coordinates(leaves);
  for (std::size_t i = 0; i < leaves.size(); ++i) {
    const LatticeCell cell = cell_of(leaves[i]);
    for (std::size_t axis = 0; axis < 3; ++axis) REQUIRE(coordinates[3 * i + axis] == cell[axis]);
    for (std::size_t c = 0; c < 8; ++c) {
      const auto row = static_cast<std::size_t>(vertices.of_cells[8 * i + c]);
      for (std::size_t axis = 0; axis < 3; ++axis) {
        const int step = static_cast<int>(c >> (2 - axis) & 1);
        REQUIRE(vertices.coordinates[3 * row + axis] == cell[axis] + step);
      }
    }
  }
  const radarsdf::VertexTable planes(leaves, 1, 2, radarsdf::Encoding::kTriQuadtree, 1);
  CHECK_THROWS_AS(radarsdf::leaf_vertices(planes), std::invalid_argument);
}

TEST_CASE("a table refuses what it cannot hold") {
  using radarsdf::Encoding;
  using radarsdf::VertexTable;
  CHECK_THROWS_AS(VertexTable({2, 1}, 1, 1, Encoding::kOctree, 1), std::invalid_argument);
  CHECK_THROWS_AS(VertexTable({1, 1}, 1, 1, Encoding::kOctree, 1), std::invalid_argument);
  CHECK_THROWS_AS(VertexTable({1}, 0, 1, Encoding::kOctree, 1), std::invalid_argument);
  CHECK_THROWS_AS(VertexTable({1}, 1, 0, Encoding::kOctree, 1), std::invalid_argument);
  CHECK_THROWS_AS(VertexTable({1}, 1, radarsdf::kMaxLevels + 1, Encoding::kOctree, 1), std::invalid_argument);
  CHECK_THROWS_AS(VertexTable({std::uint64_t{1} << 63}, 1, 1, Encoding::kOctree, 1), std::invalid_argument);
  for (std::size_t axis = 0; axis < 3; ++axis) {  // the far vertex of a cell of the coarser level must fit, too
    std::uint32_t cell[3] = {};
    const auto key_at = [&](std::uint32_t coordinate) {
      cell[axis] = coordinate;
      return radarsdf::morton_key(cell[0], cell[1], cell[2]);
    };
    constexpr std::uint32_t kEnd = (1u << radarsdf::kAxisBits) - 4;
    CHECK(VertexTable({key_at(kEnd - 1)}, 1, 2, Encoding::kOctree, 1).num_rows() == 16);
    CHECK_THROWS_AS(VertexTable({key_at(kEnd)}, 1, 2, Encoding::kOctree, 1), std::invalid_argument);
  }
}
