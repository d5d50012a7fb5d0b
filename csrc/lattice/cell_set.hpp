// Set of occupied leaf cells, filled from points in parallel, chunk by chunk.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"

namespace radarsdf {

// Morton key of the leaf cell of each point, (count, 3), local frame, m. Throws std::invalid_argument for a point that
// is not finite or farther than a million cells from the origin.
template <typename T>
void cell_keys(const T* points, std::int64_t count, double leaf_size_m, std::uint64_t* keys, int num_threads);

class CellSet {
 public:
  explicit CellSet(double leaf_size_m);

  // Inserts the cells of points. Throws like cell_keys, before anything is stored.
  template <typename T>
  void insert(const T* points, std::int64_t count, int num_threads);

  // Inserts the cells of the points at offsets_m (num_offsets,) behind the returns along each ray. points, directions:
  // (count, 3), local frame, m. Throws like cell_keys, possibly after earlier points are stored.
  void insert_along(const float* points, const float* directions, std::int64_t count, const float* offsets_m,
                    std::int64_t num_offsets, int num_threads);

  // Inserts the cells that rays cross within reach_m before and behind their returns. points, directions: (count, 3),
  // local frame, m, unit directions. Throws like insert_along.
  void insert_rays(const float* points, const float* directions, std::int64_t count, double reach_m, int num_threads);

  std::int64_t size() const;

  // Ascending Morton keys of the cells, independent of the number of threads and the order of insertion.
  std::vector<std::uint64_t> sorted_keys(int num_threads) const;

 private:
  // Bit masks of blocks of 4 x 4 x 4 cells: neighbours share a look-up, and only blocks have to be sorted.
  struct Partition {
    FlatMap numbers;  // indices of blocks by key
    std::vector<std::uint64_t> masks;
  };

  // The partition of a block is a function of its hash, so threads fill different partitions without locks.
  static constexpr int kPartitions = 64;

  // Cells to insert, by partition. Consecutive cells of a block are one entry.
  class Marks;

  static std::size_t partition_of(std::uint64_t block);

  // Inserts what mark(begin, end, marks) adds for the parts [begin, end) of `count` rays or points.
  template <typename Mark>
  void insert_marks(std::int64_t count, int num_threads, const Mark& mark);

  double leaf_size_m_;
  std::array<Partition, kPartitions> partitions_;
};

}  // namespace radarsdf
