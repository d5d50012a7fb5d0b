// Visibility counts: scans with rays reaching a place, and scans with returns there.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"

namespace radarsdf {

// Visibility is counted in cubes of 2^kVisibilityLevels leaf cells along each edge, larger than the spacing of rays in
// a scan, so that a place between two rays counts as visible.
constexpr int kVisibilityLevels = 3;

// A ray is traced from its return towards the sensor until other rays of its scan, which go to the same sensor, have
// passed this many cubes in a row. On `hugin` this finds 99.0 % of the counts in half the time; 3 cubes find 98.1 %.
constexpr int kPassedCubes = 4;

// Cubes that the rays of one scan reach, as bit masks of blocks of 4 x 4 x 4 cubes: consecutive cubes of a ray share a
// look-up, and the table stays in the cache.
class ReachedCubes {
 public:
  // Traces a ray from its return, until earlier rays have passed kPassedCubes cubes in a row.
  void trace(const float* point, const float* direction, double range_m, double leaf_size_m);

  // Calls visit(block_key, mask) for each block with reached cubes.
  template <typename Visit>
  void for_each_block(const Visit& visit) const {
    for (const Block& block : blocks_) visit(block.key, block.mask);
  }

  void clear() {
    numbers_.clear();
    blocks_.clear();
  }

 private:
  struct Block {
    std::uint64_t key, mask;
  };

  Block& block_at(std::uint64_t key);

  FlatMap numbers_;  // indices of blocks by key
  std::vector<Block> blocks_;
};

// Throws std::invalid_argument unless all rays, from their sensors, lie within a million leaf cells of the origin.
void check_whole_rays(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                      double leaf_size_m);

// visibility: (num_leaves), for each leaf cell the number of scans with a ray through or into its cube. The rays of a
// scan begin at one sensor: of those that converge towards it, one is traced on. leaf_keys: (num_leaves) unique
// ascending Morton keys; points, directions: (count, 3), ranges_m: (count), local frame, m; scans: (count), ascending,
// the scan of each ray. Throws std::invalid_argument for rays without keys.
void count_visibility(const std::uint64_t* leaf_keys, std::int64_t num_leaves, double leaf_size_m, const float* points,
                      const float* directions, const float* ranges_m, const std::int32_t* scans, std::int64_t count,
                      std::uint32_t* visibility, int num_threads);

// scans_of_cell: (num_cells), the number of different scans with returns in each cell. cells: (count), the cell of each
// return; scans: (count), ascending, its scan.
void count_scans(const std::int32_t* cells, const std::int32_t* scans, std::int64_t count, std::int64_t num_cells,
                 std::uint32_t* scans_of_cell, int num_threads);

}  // namespace radarsdf
