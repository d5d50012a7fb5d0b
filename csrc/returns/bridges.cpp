// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/bridges.hpp"

#include <algorithm>
#include <iterator>
#include <stdexcept>

#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "util/parallel.hpp"
#include "util/parallel_sort.hpp"

namespace radarsdf {
namespace {

constexpr std::int32_t kEdge = 1 << kRegionBits;
static_assert(kMostBridgeCells + 1 < kEdge, "the other end lies in a region next to that of the first");

// A region and its 26 neighbours, last coordinate fastest: look-ups of their cells need no hash.
class RegionsRound {
 public:
  explicit RegionsRound(const CellBlocks& cells) : cells_(&cells) {}

  void move_to(std::uint64_t region_key) {
    if (region_key == region_key_) return;
    region_key_ = region_key;
    for (int i = 0; i < 27; ++i) {
      regions_[i] =
          cells_->region(morton_key(morton_coordinate(region_key, 0) + static_cast<std::uint32_t>(i / 9) - 1,
                                    morton_coordinate(region_key, 1) + static_cast<std::uint32_t>(i / 3 % 3) - 1,
                                    morton_coordinate(region_key, 2) + static_cast<std::uint32_t>(i % 3) - 1));
    }
  }

  // Row of the cell at these coordinates relative to the first cell of the central region, or -1.
  std::int32_t row(const std::int32_t* at) const {
    const auto region = [](std::int32_t v) { return (v + kEdge) >> kRegionBits; };
    const Occupancy* found = regions_[9 * region(at[0]) + 3 * region(at[1]) + region(at[2])];
    if (found == nullptr) return -1;
    const auto part = [&](int axis) { return spread_[at[axis] & (kEdge - 1)] << axis; };
    const std::uint64_t inside = part(0) | part(1) | part(2);
    const Occupancy* block = cells_->block(*found, CellBlocks::block_key(inside));
    return block != nullptr ? block->row(inside) : -1;
  }

 private:
  static constexpr std::uint64_t spread_[kEdge] = {0,   1,   8,   9,   64,  65,  72,  73,
                                                   512, 513, 520, 521, 576, 577, 584, 585};  // spread_bits of 0 to 15

  const CellBlocks* cells_;
  std::uint64_t region_key_ = kEmptyKey;
  const Occupancy* regions_[27] = {};
};

struct Direction {
  std::int32_t step[3];
};

// One direction of each opposite pair.
std::vector<Direction> directions() {
  std::vector<Direction> found;
  for (std::int32_t i = 14; i < 27; ++i) found.push_back({{i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1}});
  return found;
}

}  // namespace

std::vector<std::uint64_t> bridge_cells(const std::uint64_t* leaf_keys, std::int64_t num_leaves,
                                        const std::uint64_t* ends, const double* support, std::int64_t num_ends,
                                        int max_cells, double least_dense, int num_threads) {
  if (max_cells > kMostBridgeCells) throw std::invalid_argument("bridges are too long");
  const CellBlocks cells(ends, num_ends);
  const std::vector<Direction> ways = directions();
  constexpr std::int64_t kEnds = 1 << 13;  // per task
  std::vector<std::vector<std::uint64_t>> parts(static_cast<std::size_t>((num_ends + kEnds - 1) / kEnds));
  parallel_tasks(static_cast<std::int64_t>(parts.size()), num_threads, [&](std::int64_t task) {
    std::vector<std::uint64_t>& found = parts[static_cast<std::size_t>(task)];
    RegionsRound round(cells);
    for (std::int64_t i = task * kEnds; i < std::min(num_ends, (task + 1) * kEnds); ++i) {
      round.move_to(CellBlocks::region_key(ends[i]));
      std::int32_t cell[3], own[3];  // absolute, and relative to the region's first cell
      for (int axis = 0; axis < 3; ++axis) {
        cell[axis] = static_cast<std::int32_t>(morton_coordinate(ends[i], axis));
        own[axis] = cell[axis] & (kEdge - 1);
      }
      for (const Direction& way : ways) {
        for (std::int32_t distance = 2; distance <= max_cells + 1; ++distance) {
          const std::int32_t at[3] = {own[0] + distance * way.step[0], own[1] + distance * way.step[1],
                                      own[2] + distance * way.step[2]};
          const std::int32_t other = round.row(at);
          if (other < 0 || !(support[i] + support[other] < least_dense)) continue;
          for (std::int32_t k = 1; k < distance; ++k) {
            const std::int32_t between[3] = {cell[0] + k * way.step[0], cell[1] + k * way.step[1],
                                             cell[2] + k * way.step[2]};
            found.push_back(lattice_key(between, 0));
          }
        }
      }
    }
    std::sort(found.begin(), found.end());
    found.erase(std::unique(found.begin(), found.end()), found.end());
  });
  std::vector<std::uint64_t> between;
  for (std::vector<std::uint64_t>& part : parts) {
    between.insert(between.end(), part.begin(), part.end());
    part = {};
  }
  parallel_sort(between, num_threads);
  between.erase(std::unique(between.begin(), between.end()), between.end());
  std::vector<std::uint64_t> all;
  all.reserve(static_cast<std::size_t>(num_leaves) + between.size());
  std::set_union(leaf_keys, leaf_keys + num_leaves, between.begin(), between.end(), std::back_inserter(all));
  return all;
}

}  // namespace radarsdf
