#include "returns/bridges.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <stdexcept>

#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int32_t kEdge = 1 << kRegionBits, kBlockEdge = 1 << kBlockBits;
static_assert(kMostBridgeCells + 1 < kEdge, "the other end lies in a region next to that of the first");

// Cells of a block, as a bit mask.
struct Marks {
  std::uint64_t block, mask;
};

// The ends in a region and around it, by block, and the marked cells between them. Coordinates are relative to the
// first cell of the surrounding blocks.
class Neighbourhood {
 public:
  Neighbourhood(const CellBlocks& ends, std::int32_t reach_cells)
      : ends_(&ends),
        halo_((reach_cells + kBlockEdge - 1) / kBlockEdge),
        edge_(kBlockEdge + 2 * halo_),
        there_(edge_ * edge_ * edge_),
        marked_(there_.size()) {}

  void move_to(std::uint64_t region_key) {
    std::fill(there_.begin(), there_.end(), Occupancy{0, 0});
    for (int axis = 0; axis < 3; ++axis)
      first_[axis] = static_cast<std::int32_t>(morton_coordinate(region_key, axis)) * kBlockEdge - halo_;
    for (int i = 0; i < 27; ++i) {
      const std::int32_t steps[3] = {i / 9 - 1, i / 3 % 3 - 1, i % 3 - 1};
      std::uint32_t at[3];
      for (int axis = 0; axis < 3; ++axis)
        at[axis] = morton_coordinate(region_key, axis) + static_cast<std::uint32_t>(steps[axis]);
      const Occupancy* region = ends_->region(morton_key(at[0], at[1], at[2]));
      if (region == nullptr) continue;
      for (std::uint64_t bits = region->mask; bits != 0; bits &= bits - 1) {
        const auto part = static_cast<std::uint64_t>(lowest_bit(bits));
        std::int32_t index = 0;
        bool inside = true;
        for (int axis = 0; axis < 3; ++axis) {
          const std::int32_t block =
              steps[axis] * kBlockEdge + static_cast<std::int32_t>(morton_coordinate(part, axis)) + halo_;
          inside = inside && block >= 0 && block < edge_;
          index = index * edge_ + block;
        }
        if (inside) there_[index] = *ends_->block(*region, part);
      }
    }
  }

  std::int32_t first_cell() const { return halo_ * kBlockEdge; }  // of the central region, along each axis

  // Row of the end at these coordinates, or -1.
  std::int32_t row(const std::int32_t* at) const { return there_[block_of(at)].row(part_of(at)); }

  void mark(const std::int32_t* at) { marked_[block_of(at)] |= std::uint64_t{1} << part_of(at); }

  // Appends the marked cells, and forgets them.
  void take(std::vector<Marks>& marks) {
    for (std::size_t i = 0; i < marked_.size(); ++i) {
      if (marked_[i] == 0) continue;
      const auto place = static_cast<std::int32_t>(i);
      const std::int32_t block[3] = {first_[0] + place / (edge_ * edge_), first_[1] + place / edge_ % edge_,
                                     first_[2] + place % edge_};
      marks.push_back({lattice_key(block, 0), marked_[i]});
      marked_[i] = 0;
    }
  }

 private:
  std::size_t block_of(const std::int32_t* at) const {
    const auto block = [&](int axis) { return at[axis] >> kBlockBits; };
    return (block(0) * edge_ + block(1)) * edge_ + block(2);
  }

  const CellBlocks* ends_;
  std::int32_t halo_, edge_;  // blocks
  std::int32_t first_[3] = {};
  std::vector<Occupancy> there_;
  std::vector<std::uint64_t> marked_;
};

// Calls visit(first, last) for each run of equal group_of(i), of i below count, that begins in [begin, end).
template <typename GroupOf, typename Visit>
void for_each_run(std::int64_t begin, std::int64_t end, std::int64_t count, const GroupOf& group_of,
                  const Visit& visit) {
  std::int64_t i = begin;
  while (i > 0 && i < count && group_of(i) == group_of(i - 1)) ++i;
  while (i < end) {
    const std::int64_t first = i;
    while (i < count && group_of(i) == group_of(first)) ++i;
    visit(first, i);
  }
}

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
  constexpr std::int64_t kEnds = 1 << 13;  // per task, which processes the regions that begin there
  std::vector<std::vector<Marks>> parts(num_chunks(num_ends, kEnds));
  parallel_chunks(num_ends, kEnds, num_threads, [&](std::int64_t task, std::int64_t begin, std::int64_t end) {
    Neighbourhood near(cells, max_cells + 1);
    const auto region_of = [&](std::int64_t i) { return CellBlocks::region_key(ends[i]); };
    for_each_run(begin, end, num_ends, region_of, [&](std::int64_t first, std::int64_t last) {
      near.move_to(region_of(first));
      for (std::int64_t i = first; i < last; ++i) {
        std::int32_t own[3];
        for (int axis = 0; axis < 3; ++axis) {
          const auto cell = static_cast<std::int32_t>(morton_coordinate(ends[i], axis));
          own[axis] = near.first_cell() + (cell & (kEdge - 1));
        }
        for (const Direction& way : ways) {
          const auto at = [&](std::int32_t distance) {
            return std::array<std::int32_t, 3>{own[0] + distance * way.step[0], own[1] + distance * way.step[1],
                                               own[2] + distance * way.step[2]};
          };
          for (std::int32_t distance = 2; distance <= max_cells + 1; ++distance) {
            const std::int32_t other = near.row(at(distance).data());
            if (other < 0 || !(support[i] + support[other] < least_dense)) continue;
            for (std::int32_t k = 1; k < distance; ++k) near.mark(at(k).data());
          }
        }
      }
      near.take(parts[task]);
    });
  });
  std::vector<Marks> between;
  for (std::vector<Marks>& part : parts) {
    between.insert(between.end(), part.begin(), part.end());
    part = {};
  }
  std::sort(between.begin(), between.end(), [](const Marks& a, const Marks& b) { return a.block < b.block; });

  std::vector<std::uint64_t> all;
  all.reserve(num_leaves);
  std::int64_t leaf = 0;
  for (std::size_t i = 0; i < between.size();) {
    const std::uint64_t block = between[i].block;
    std::uint64_t mask = 0;
    for (; i < between.size() && between[i].block == block; ++i) mask |= between[i].mask;
    for (; leaf < num_leaves && CellBlocks::block_key(leaf_keys[leaf]) <= block; ++leaf) {
      if (CellBlocks::block_key(leaf_keys[leaf]) < block) {
        all.push_back(leaf_keys[leaf]);
      } else {
        mask |= std::uint64_t{1} << (leaf_keys[leaf] & 63);
      }
    }
    for (; mask != 0; mask &= mask - 1) all.push_back(CellBlocks::key_in_block(block, lowest_bit(mask)));
  }
  all.insert(all.end(), leaf_keys + leaf, leaf_keys + num_leaves);
  return all;
}

void block_medians(const std::uint64_t* keys, const double* values, std::int64_t count, int levels, double* medians,
                   int num_threads) {
  const auto block_of = [&](std::int64_t i) { return keys[i] >> (3 * levels); };
  constexpr std::int64_t kCells = 1 << 14;  // per task, which processes the blocks that begin there
  parallel_chunks(count, kCells, num_threads, [&](std::int64_t, std::int64_t begin, std::int64_t end) {
    std::vector<double> positive;
    for_each_run(begin, end, count, block_of, [&](std::int64_t first, std::int64_t last) {
      positive.clear();
      for (std::int64_t i = first; i < last; ++i) {
        if (values[i] > 0) positive.push_back(values[i]);
      }
      double median = 0;
      if (!positive.empty()) {
        const auto upper = positive.begin() + static_cast<std::ptrdiff_t>(positive.size() / 2);
        std::nth_element(positive.begin(), upper, positive.end());
        median = positive.size() % 2 == 1 ? *upper : (*std::max_element(positive.begin(), upper) + *upper) / 2;
      }
      std::fill(medians + first, medians + last, median);
    });
  });
}

}  // namespace radarsdf
