#include "returns/visibility.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "lattice/cell_blocks.hpp"
#include "lattice/cell_walk.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

// Calls count(begin, end, counts) for parts of the returns that hold whole scans, and sums their counts (places,):
// integers, independent of the number of threads.
template <typename Count>
std::vector<std::uint32_t> count_by_scans(const std::int32_t* scans, std::int64_t size, std::int64_t places,
                                          int num_threads, const Count& count) {
  const std::int64_t parts = size > (1 << 14) ? resolve_num_threads(num_threads) : 1;
  std::vector<std::vector<std::uint32_t>> counts(parts);
  const auto begin_of = [&](std::int64_t part) {
    const std::int64_t near = size * part / parts;
    if (near == 0 || near == size) return near;
    return static_cast<std::int64_t>(std::lower_bound(scans, scans + size, scans[near]) - scans);
  };
  parallel_tasks(parts, num_threads, [&](std::int64_t part) {
    std::vector<std::uint32_t>& own = counts[part];
    own.resize(places);
    count(begin_of(part), begin_of(part + 1), own);
  });
  for (std::size_t part = 1; part < counts.size(); ++part) {
    std::transform(counts[0].begin(), counts[0].end(), counts[part].begin(), counts[0].begin(), std::plus<>());
  }
  return std::move(counts[0]);
}

void check_scans(const std::int32_t* scans, std::int64_t count) {
  if (!std::is_sorted(scans, scans + count) || (count > 0 && scans[0] < 0)) {
    throw std::invalid_argument("scans must be ascending numbers of at least 0");
  }
}

}  // namespace

ReachedCubes::Block& ReachedCubes::block_at(std::uint64_t key) {
  const auto next = static_cast<std::int32_t>(blocks_.size()), found = numbers_.find_or_insert(key, next);
  if (found == next) blocks_.push_back({key, 0});
  return blocks_[found];
}

void ReachedCubes::trace(const float* point, const float* direction, double range_m, double leaf_size_m) {
  const float backwards[3] = {-direction[0], -direction[1], -direction[2]};
  CellWalk cube(point, backwards, 0, range_m, (1 << kVisibilityLevels) * leaf_size_m, kAxisBias >> kVisibilityLevels);
  Block* block = nullptr;
  for (int in_a_row = 0; cube.inside() && in_a_row < kPassedCubes; cube.next()) {
    const std::uint64_t key = cube.key(), bit = std::uint64_t{1} << (key & 63);
    if (block == nullptr || block->key != CellBlocks::block_key(key)) block = &block_at(CellBlocks::block_key(key));
    in_a_row = (block->mask & bit) != 0 ? in_a_row + 1 : 0;
    block->mask |= bit;
  }
}

void check_whole_rays(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                      double leaf_size_m) {
  const double limit_m = (kAxisBias - (1 << kMaxLevels)) * leaf_size_m;
  bool inside = true;
  for (std::int64_t i = 0; i < count; ++i) {  // NaN fails the comparison too
    const double range_m = ranges_m[i];
    inside = inside & (range_m >= 0);
    for (std::int64_t k = 3 * i; k < 3 * i + 3; ++k) {
      const double sensor_m = points[k] - range_m * double{directions[k]};
      inside = inside & (std::abs(double{points[k]}) < limit_m) & (std::abs(sensor_m) < limit_m);
    }
  }
  if (!inside) throw std::invalid_argument("rays must be finite and within a million cells of the origin");
}

void count_visibility(const std::uint64_t* leaf_keys, std::int64_t num_leaves, double leaf_size_m, const float* points,
                      const float* directions, const float* ranges_m, const std::int32_t* scans, std::int64_t count,
                      std::uint32_t* visibility, int num_threads) {
  const auto cube_key = [](std::uint64_t leaf_key) { return leaf_key >> (3 * kVisibilityLevels); };
  std::vector<std::uint64_t> keys;
  for (std::int64_t i = 0; i < num_leaves; ++i) {
    if (keys.empty() || keys.back() != cube_key(leaf_keys[i])) keys.push_back(cube_key(leaf_keys[i]));
  }
  check_scans(scans, count);
  const CellBlocks cubes(keys.data(), static_cast<std::int64_t>(keys.size()));
  check_whole_rays(points, directions, ranges_m, count, leaf_size_m);
  const auto of_rays = [&](std::int64_t begin, std::int64_t end, std::vector<std::uint32_t>& counts) {
    NearbyRows near(cubes);
    ReachedCubes reached;  // by rays of the current scan
    for (std::int64_t i = begin; i < end; ++i) {
      if (i % (1 << 12) == 0) check_interrupt();
      reached.trace(points + 3 * i, directions + 3 * i, ranges_m[i], leaf_size_m);
      if (i + 1 < end && scans[i + 1] == scans[i]) continue;
      reached.for_each_block([&](std::uint64_t block_key, std::uint64_t mask) {
        const Occupancy& block = near.block(block_key);
        for (mask &= block.mask; mask != 0; mask &= mask - 1)
          ++counts[block.row(static_cast<std::uint64_t>(lowest_bit(mask)))];
      });
      reached.clear();
    }
  };
  const auto counts = count_by_scans(scans, count, cubes.size(), num_threads, of_rays);
  std::size_t row = 0;
  for (std::int64_t i = 0; i < num_leaves; ++i) {
    if (keys[row] != cube_key(leaf_keys[i])) ++row;
    visibility[i] = counts[row];
  }
}

void count_scans(const std::int32_t* cells, const std::int32_t* scans, std::int64_t count, std::int64_t num_cells,
                 std::uint32_t* scans_of_cell, int num_threads) {
  check_scans(scans, count);
  const auto of_returns = [&](std::int64_t begin, std::int64_t end, std::vector<std::uint32_t>& counts) {
    std::vector<std::int32_t> last_scan(counts.size(), -1);  // last scan counted in each cell
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int32_t cell = cells[i];
      counts[cell] += last_scan[cell] != scans[i] ? 1 : 0;
      last_scan[cell] = scans[i];
    }
  };
  const auto counts = count_by_scans(scans, count, num_cells, num_threads, of_returns);
  std::copy(counts.begin(), counts.end(), scans_of_cell);
}

}  // namespace radarsdf
