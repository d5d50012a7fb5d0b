#include "returns/growing_sums.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <cstdint>
#include <numeric>
#include <stdexcept>
#include <vector>

#include "helpers.hpp"
#include "lattice/cell_set.hpp"

namespace {

using radarsdf::GrowingSums;
using radarsdf::SumsChange;

constexpr double kSize = 0.25;
constexpr std::int64_t kRays = 2000;

// A scan from the origin. It has one ray more than its count: reading that one is an error.
struct Scan {
  std::vector<float> points, directions, ranges_m;

  explicit Scan(unsigned seed) : points(test::normal_numbers<float>(3 * kRays, 4, seed)) {
    points.insert(points.end(), {50, 50, 50});
    for (std::size_t i = 0; i < points.size(); i += 3) {
      ranges_m.push_back(std::hypot(points[i], points[i + 1], points[i + 2]));
      for (std::size_t axis = 0; axis < 3; ++axis) directions.push_back(points[i + axis] / ranges_m.back());
    }
  }

  std::vector<std::uint64_t> cells() const {
    radarsdf::CellSet cells(kSize);
    cells.insert(points.data(), kRays, 1);
    return cells.sorted_keys(1);
  }
};

SumsChange change_by(const Scan& scan, std::int64_t sign) {
  SumsChange change(kSize, kSize / 4096);
  change.collect({scan.points.data(), scan.directions.data(), scan.ranges_m.data(), kRays}, sign);
  return change;
}

struct Contents {
  std::vector<std::uint64_t> blocks;
  radarsdf::SumsOfCells cells;
  radarsdf::VisibilityOfBlocks visibility;
};

Contents contents_of(const GrowingSums& sums) {
  const std::vector<std::uint64_t> blocks = sums.block_keys();
  const auto count = static_cast<std::int64_t>(blocks.size());
  return {blocks, sums.sums_of(blocks.data(), count), sums.visibility_of(blocks.data(), count)};
}

void check_same(const Contents& one, const Contents& other) {
  CHECK(one.blocks == other.blocks);
  CHECK(one.cells.keys == other.cells.keys);
  CHECK(one.cells.sums == other.cells.sums);
  CHECK(one.cells.scans == other.cells.scans);
  CHECK(one.visibility.keys == other.visibility.keys);
  CHECK(one.visibility.visibility == other.visibility.visibility);
}

}  // namespace

TEST_CASE("growing sums equal the sums of the present scans, without a trace of removed ones") {
  const Scan first(1), second(2);
  GrowingSums sums;
  sums.apply(change_by(first, 1));
  const Contents alone = contents_of(sums);
  CHECK(alone.cells.keys == first.cells());
  std::int64_t returns = 0;
  for (std::size_t i = 0; i < alone.cells.sums.size(); i += radarsdf::kSums) returns += alone.cells.sums[i];
  CHECK(returns == kRays);

  sums.apply(change_by(second, 1));
  const Contents both = contents_of(sums);
  const auto scans = std::accumulate(both.cells.scans.begin(), both.cells.scans.end(), std::size_t{0});
  CHECK(scans == first.cells().size() + second.cells().size());
  sums.apply(change_by(second, -1));
  check_same(contents_of(sums), alone);
  CHECK_THROWS_AS(sums.apply(change_by(second, -1)), std::invalid_argument);
  check_same(contents_of(sums), alone);
  sums.apply(change_by(first, -1));
  CHECK((sums.num_cells() == 0 && sums.num_blocks() == 0));
}
