// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "cell_set.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <stdexcept>

#include "cell.hpp"
#include "morton.hpp"
#include "parallel.hpp"

namespace radarsdf {

CellSet::CellSet(double leaf_size_m) : leaf_size_m_(leaf_size_m) {
  if (!(leaf_size_m > 0) || !std::isfinite(leaf_size_m))
    throw std::invalid_argument("leaf_size_m must be positive and finite");
}

template <typename T>
void cell_keys(const T* points, std::int64_t count, double leaf_size_m, std::uint64_t* keys, int num_threads) {
  // The limit leaves room for the far vertex of the last cell of every level. NaN fails the comparison too.
  const T inverse = static_cast<T>(1.0 / leaf_size_m), limit = static_cast<T>(kAxisBias - (1 << kMaxLevels));
  std::atomic<bool> inside{true};
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::uint32_t cell[3] = {};
      for (int axis = 0; axis < 3; ++axis) {
        const T u = points[3 * i + axis] * inverse;
        if (!(std::abs(u) < limit)) {
          inside = false;
          return;
        }
        cell[axis] = static_cast<std::uint32_t>(static_cast<std::int32_t>(std::floor(u)) + kAxisBias);
      }
      keys[i] = morton_key(cell[0], cell[1], cell[2]);
    }
  });
  if (!inside) throw std::invalid_argument("points must be finite and within a million cells of the origin");
}

template <typename T>
void CellSet::insert(const T* points, std::int64_t count, int num_threads) {
  std::vector<std::uint64_t> keys(static_cast<std::size_t>(count));
  cell_keys(points, count, leaf_size_m_, keys.data(), num_threads);
  const std::int64_t threads = std::min<std::int64_t>(resolve_num_threads(num_threads), kPartitions);
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    std::uint64_t previous = kEmptyKey;  // points along one ray often share a cell
    for (const std::uint64_t key : keys) {
      if (key == previous) continue;
      previous = key;
      // Bits that FlatMap does not use for the slot, or the partitions would fill unevenly.
      const std::uint64_t partition = (hash_key(key) >> 16) % kPartitions;
      if (static_cast<std::int64_t>(partition) % threads == task) partitions_[partition].insert(key, 0);
    }
  });
}

std::int64_t CellSet::size() const {
  std::int64_t total = 0;
  for (const FlatMap& partition : partitions_) total += static_cast<std::int64_t>(partition.size());
  return total;
}

std::vector<std::uint64_t> CellSet::sorted_keys(int num_threads) const {
  std::vector<std::uint64_t> keys;
  keys.reserve(static_cast<std::size_t>(size()));
  for (const FlatMap& partition : partitions_) {
    for (const Slot& slot : partition.slots()) {
      if (slot.key != kEmptyKey) keys.push_back(slot.key);
    }
  }
  parallel_sort(keys, num_threads);
  return keys;
}

void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads) {
  const auto size = static_cast<std::int64_t>(keys.size());
  std::int64_t blocks = 1;
  const std::int64_t threads = resolve_num_threads(num_threads);
  // Several for a thread where one would keep whoever wants to interrupt the call waiting.
  while (size / blocks > (blocks * 2 <= threads ? 1 << 15 : 1 << 22)) blocks *= 2;
  const auto at = [&](std::int64_t i) { return keys.begin() + size * i / blocks; };
  parallel_tasks(blocks, num_threads, [&](std::int64_t i) { std::sort(at(i), at(i + 1)); });
  for (std::int64_t width = 1; width < blocks; width *= 2) {
    parallel_tasks(blocks / (2 * width), num_threads, [&](std::int64_t i) {
      std::inplace_merge(at(2 * i * width), at((2 * i + 1) * width), at((2 * i + 2) * width));
    });
  }
}

template void cell_keys(const float*, std::int64_t, double, std::uint64_t*, int);
template void cell_keys(const double*, std::int64_t, double, std::uint64_t*, int);
template void CellSet::insert(const float*, std::int64_t, int);
template void CellSet::insert(const double*, std::int64_t, int);

}  // namespace radarsdf
