#include <doctest/doctest.h>

#include <array>
#include <cmath>
#include <map>
#include <random>
#include <set>
#include <vector>

#include "helpers.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/flat_map.hpp"
#include "lattice/morton.hpp"
#include "lattice/vertex_table.hpp"

using LatticeCell = std::array<std::int32_t, 3>;

namespace {

std::uint64_t key_of(const LatticeCell& cell) { return radarsdf::lattice_key(cell.data()); }

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

TEST_CASE("a Morton key decodes to its coordinates, and shifted to those of its parent") {
  std::mt19937 generator(1);
  constexpr std::uint32_t kLast = (1u << radarsdf::kAxisBits) - 1;
  for (int i = 0; i < 10000; ++i) {
    std::array<std::uint32_t, 3> c{};
    for (std::uint32_t& v : c) v = i == 0 ? 0 : i == 1 ? kLast : generator() & kLast;
    const std::uint64_t key = radarsdf::morton_key(c[0], c[1], c[2]);
    REQUIRE((key >> 63) == 0);
    for (int axis = 0; axis < 3; ++axis) {
      REQUIRE(radarsdf::morton_coordinate(key, axis) == c[axis]);
    }
    REQUIRE((key >> 3) == radarsdf::morton_key(c[0] >> 1, c[1] >> 1, c[2] >> 1));
    REQUIRE((key & 7) == ((c[0] & 1) | (c[1] & 1) << 1 | (c[2] & 1) << 2));
  }
}

TEST_CASE("FlatMap behaves like std::unordered_map") {
  std::mt19937_64 generator(2);
  std::vector<std::uint64_t> keys(16000);  // random, for collisions: consecutive numbers have none
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
  for (std::int32_t i = 0; i < 40000; ++i) {  // after backward shifts, all remaining keys are found
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
          const auto& used = axes[group];
          // Coordinates of a vertex along the axes used by the group.
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
          auto cell = static_cast<std::size_t>(first_cell);
          for (const std::uint64_t key : keys) {
            const std::size_t face = groups == 1 ? cell : static_cast<std::size_t>(table.faces()[3 * cell + group]);
            for (int c = 0; c < corners; ++c) REQUIRE(table.rows()[face * corners + c] == row_of[vertex(key, c)]);
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
