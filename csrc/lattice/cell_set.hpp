// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The set of occupied leaf cells, filled from points in parallel, a chunk at a time.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"

namespace radarsdf {

// Morton key of the leaf cell of each point, (count, 3) in the map's local frame, metres. Throws std::invalid_argument
// for a point that is not finite or further than a million cells from the local origin.
template <typename T>
void cell_keys(const T* points, std::int64_t count, double leaf_size_m, std::uint64_t* keys, int num_threads);

class CellSet {
 public:
  explicit CellSet(double leaf_size_m);

  // Marks the cells of the points. Throws as cell_keys does, before anything is stored.
  template <typename T>
  void insert(const T* points, std::int64_t count, int num_threads);

  // Marks the cells of the points at these distances behind the returns, along each ray: points, directions: (count,
  // 3), local frame, m; offsets_m: (num_offsets,). Throws as cell_keys does; what comes before the fault may be stored.
  void insert_along(const float* points, const float* directions, std::int64_t count, const float* offsets_m,
                    std::int64_t num_offsets, int num_threads);

  // Marks the cells that rays go through within reach_m before and behind their returns. points, directions: (count,
  // 3), local frame, m, directions of unit length. Throws likewise.
  void insert_rays(const float* points, const float* directions, std::int64_t count, double reach_m, int num_threads);

  std::int64_t size() const;

  // Morton keys of the cells, ascending: the same for any number of threads and any order of insertion.
  std::vector<std::uint64_t> sorted_keys(int num_threads) const;

 private:
  // Cells by blocks of 4 x 4 x 4, a bit for each: neighbours share a look-up, and only blocks have to be sorted.
  struct Partition {
    FlatMap numbers;  // of blocks
    std::vector<std::uint64_t> masks;
  };

  // A block's partition is a function of its hash, so threads fill different partitions and need no locks.
  static constexpr int kPartitions = 64;

  // Cells that are to be marked, sorted into partitions. Cells that follow each other in a block are one entry.
  class Marks;

  static std::size_t partition_of(std::uint64_t block);

  // Marks what mark(begin, end, marks) adds for the parts [begin, end) of `count` rays or points.
  template <typename Mark>
  void insert_marks(std::int64_t count, int num_threads, const Mark& mark);

  double leaf_size_m_;
  std::array<Partition, kPartitions> partitions_;
};

}  // namespace radarsdf
