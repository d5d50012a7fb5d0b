// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The set of occupied leaf cells, filled from points in parallel, a chunk at a time.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "flat_map.hpp"

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

  std::int64_t size() const;

  // Morton keys of the cells, ascending: the same for any number of threads and any order of insertion.
  std::vector<std::uint64_t> sorted_keys(int num_threads) const;

 private:
  // A key's partition is a function of its hash, so threads fill different partitions and need no locks.
  static constexpr int kPartitions = 64;

  double leaf_size_m_;
  std::array<FlatMap, kPartitions> partitions_;
};

// Sorts in place: blocks on threads, then merged pairwise.
void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads);

}  // namespace radarsdf
