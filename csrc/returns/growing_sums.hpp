// Incremental sums over scans: adding or removing a scan takes time proportional to its returns, independent of the
// size of the table. All numbers are integers, so that removal is exact, in any order.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"
#include "returns/cell_sums.hpp"
#include "returns/visibility.hpp"

namespace radarsdf {

// The rays of one scan.
struct RaysOfScan {
  const float* points;          // (count, 3), local frame, m
  const float* directions;      // (count, 3), unit vectors
  const float* ranges_m;        // (count,)
  const std::int32_t* weights;  // (count,), positive
  std::int64_t count;
};

// A block has 8 x 8 x 8 leaf cells, the unit of visibility counts.
constexpr int kCellsOfBlock = 1 << (3 * kVisibilityLevels);

// Contents of blocks, in Morton order.
struct SumsOfCells {
  std::vector<std::uint64_t> keys;   // of leaf cells with returns
  std::vector<std::int64_t> sums;    // (keys.size(), kSums), see sum_returns
  std::vector<std::uint32_t> scans;  // number of scans with returns in each
};
struct VisibilityOfBlocks {
  std::vector<std::uint64_t> keys;        // of blocks
  std::vector<std::uint32_t> visibility;  // number of scans with a ray through or into each
};

// Accumulated change by added and removed scans.
class SumsChange {
 public:
  SumsChange(double leaf_size_m, double quantum_m) : leaf_size_m_(leaf_size_m), quantum_m_(quantum_m) {}

  // sign: 1 adds the scan, -1 removes it. Throws std::invalid_argument for rays without keys.
  void collect(const RaysOfScan& rays, std::int64_t sign);

  std::vector<std::uint64_t> block_keys() const;  // of the blocks that it may change, ascending

 private:
  friend class GrowingSums;
  struct Cell {
    std::uint64_t key;
    std::int64_t sums[kSums], scans, last;  // last: last scan of this change counted here
  };
  struct Visibility {
    std::uint64_t key;
    std::int64_t visibility;
  };

  double leaf_size_m_, quantum_m_;
  std::int64_t collected_ = 0;
  FlatMap number_of_cell_, number_of_cube_;
  std::vector<Cell> cells_;
  std::vector<Visibility> visibility_;
};

// Blocks affected by a change, ascending.
struct ChangedBlocks {
  std::vector<std::uint64_t> returns, visibility;
};

class GrowingSums {
 public:
  // Throws std::invalid_argument, without any change, if a scan that was never added would be removed.
  ChangedBlocks apply(const SumsChange& change);

  std::int64_t num_cells() const { return static_cast<std::int64_t>(number_of_cell_.size()); }
  std::int64_t num_bytes() const;

  std::vector<std::uint64_t> block_keys() const;  // ascending

  // Contents of the blocks with these ascending keys; missing ones are empty.
  SumsOfCells sums_of(const std::uint64_t* block_keys, std::int64_t count) const;
  VisibilityOfBlocks visibility_of(const std::uint64_t* block_keys, std::int64_t count) const;

  // Inserts new contents, and erases blocks with their contents. Throws std::invalid_argument, without any change, if a
  // cell or a block exists already.
  void insert(const SumsOfCells& cells, const VisibilityOfBlocks& visibility);
  void erase(const std::uint64_t* block_keys, std::int64_t count);

 private:
  struct Cell {
    std::int64_t sums[kSums];
    std::uint32_t scans;
  };
  struct Block {
    std::array<std::uint64_t, kCellsOfBlock / 64> mask{};  // cells with returns, in Morton order
    std::uint32_t visibility = 0;

    bool is_empty() const;
  };

  template <typename Visit>
  void for_each_cell(std::uint64_t block_key, const Block& block, const Visit& visit) const;

  Block& block_at(std::uint64_t key);  // created if missing
  void drop_cell(std::uint64_t key, Block& block);
  void drop_if_empty(std::uint64_t block_key);
  void reserve(std::int64_t cells, std::int64_t blocks);

  FlatMap number_of_cell_, number_of_block_;
  std::vector<Cell> cells_;
  std::vector<Block> blocks_;
  std::vector<std::int32_t> free_cells_, free_blocks_;
};

}  // namespace radarsdf
