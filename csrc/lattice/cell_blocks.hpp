// Two-level bit masks of cells: blocks of 4 x 4 x 4 cells in regions of 4 x 4 x 4 blocks. The cells of a block are
// consecutive in Morton order, so the row of a cell is that of the block's first cell plus the number of set bits below
// its own; likewise the blocks of a region. Only regions are looked up in a hash table, which thus stays small and
// rejects empty space early: rays skip empty regions, neighbour sums rarely leave a region.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"
#include "util/bits.hpp"

namespace radarsdf {

constexpr int kBlockBits = 2;                // per axis
constexpr int kRegionBits = 2 * kBlockBits;  // per axis

// Occupied parts of a cube of 4 x 4 x 4.
struct Occupancy {
  std::uint64_t mask;  // bit i: part i in Morton order is occupied
  std::int32_t first;  // row of the first occupied part; the others follow

  std::int32_t row(std::uint64_t key) const {  // row of one of the 64 parts, or -1
    const std::uint64_t bit = std::uint64_t{1} << (key & 63);
    return (mask & bit) != 0 ? first + count_bits(mask & (bit - 1)) : -1;
  }
};

// Morton bits of a coordinate in its block, and the number of a cell in its block, 0 to 63.
inline std::uint64_t part_bits(std::int32_t coordinate) {
  constexpr std::uint64_t kSpread[1 << kBlockBits] = {0, 1, 8, 9};
  return kSpread[coordinate & ((1 << kBlockBits) - 1)];
}
inline std::uint64_t part_of(const std::int32_t* cell) {
  return part_bits(cell[0]) | part_bits(cell[1]) << 1 | part_bits(cell[2]) << 2;
}

// Masks of the parts of a block at even positions along an axis (0 and 2), at position 1, and at position 3. The
// position of a part has bit `axis` of its Morton number as low bit and bit `axis + 3` as high bit.
constexpr std::uint64_t parts_where(int axis, bool low_bit, bool any_high_bit, bool high_bit) {
  std::uint64_t mask = 0;
  for (int i = 0; i < 64; ++i) {
    if ((i >> axis & 1) == low_bit && (any_high_bit || (i >> (axis + 3) & 1) == high_bit))
      mask |= std::uint64_t{1} << i;
  }
  return mask;
}
constexpr std::uint64_t kEven[3] = {parts_where(0, false, true, false), parts_where(1, false, true, false),
                                    parts_where(2, false, true, false)};
constexpr std::uint64_t kOne[3] = {parts_where(0, true, false, false), parts_where(1, true, false, false),
                                   parts_where(2, true, false, false)};
constexpr std::uint64_t kThree[3] = {parts_where(0, true, false, true), parts_where(1, true, false, true),
                                     parts_where(2, true, false, true)};

// Moves all parts by one along the axis: those that stay in the block, and those carried into the next one.
inline std::uint64_t shifted(std::uint64_t mask, int axis) {
  return (mask & kEven[axis]) << (1 << axis) | (mask & kOne[axis]) << (7 << axis);
}
inline std::uint64_t carried(std::uint64_t mask, int axis) { return (mask & kThree[axis]) >> (9 << axis); }

class CellBlocks {
 public:
  // keys: unique ascending Morton keys; the position of a key is its row. Throws std::invalid_argument.
  CellBlocks(const std::uint64_t* keys, std::int64_t count);

  std::int64_t size() const { return size_; }

  static std::uint64_t block_key(std::uint64_t key) { return key >> (3 * kBlockBits); }
  static std::uint64_t region_key(std::uint64_t key) { return key >> (3 * kRegionBits); }
  static std::uint64_t key_in_block(std::uint64_t block_key, int part) {
    return block_key << (3 * kBlockBits) | static_cast<std::uint64_t>(part);
  }

  // The blocks of a region, and the cells of one of its blocks; nullptr if empty.
  const Occupancy* region(std::uint64_t region_key) const { return at(regions_, numbers_.find(region_key)); }
  const Occupancy* block(const Occupancy& region, std::uint64_t block_key) const {
    return at(blocks_, region.row(block_key));
  }

  // The row of each key, or -1.
  void rows(const std::uint64_t* keys, std::int64_t count, std::int32_t* rows, int num_threads) const;

 private:
  static const Occupancy* at(const std::vector<Occupancy>& cubes, std::int32_t i) {
    return i >= 0 ? &cubes[i] : nullptr;
  }

  std::int64_t size_;
  FlatMap numbers_;  // indices of regions by key
  std::vector<Occupancy> regions_, blocks_;
};

// Cached look-up of keys that mostly lie in recently used blocks, or at least in the previous region. One block is
// cached for each combination of coordinate parities, so adjacent blocks do not evict each other.
class NearbyRows {
 public:
  explicit NearbyRows(const CellBlocks& cells) : cells_(&cells) {}

  // The row of a key, or -1.
  std::int32_t row(std::uint64_t key) { return block(CellBlocks::block_key(key)).row(key); }

  // The cells of a block.
  const Occupancy& block(std::uint64_t block_key) {
    Found& found = found_[block_key & 7];
    if (found.key != block_key) {
      found.key = block_key;
      const std::uint64_t region_key = CellBlocks::block_key(block_key);  // a region is a block of blocks
      if (region_key != region_key_) {
        region_key_ = region_key;
        region_ = cells_->region(region_key_);
      }
      const Occupancy* cells = region_ != nullptr ? cells_->block(*region_, block_key) : nullptr;
      found.cells = cells != nullptr ? *cells : Occupancy{0, 0};
    }
    return found.cells;
  }

 private:
  struct Found {
    std::uint64_t key = kEmptyKey;
    Occupancy cells{0, 0};
  };

  const CellBlocks* cells_;
  std::uint64_t region_key_ = kEmptyKey;
  const Occupancy* region_ = nullptr;
  Found found_[8];
};

}  // namespace radarsdf
