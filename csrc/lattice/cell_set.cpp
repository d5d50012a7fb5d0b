// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "lattice/cell_set.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <stdexcept>

#include "lattice/cell.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_walk.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/parallel_sort.hpp"

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

// By bits of the hash that FlatMap does not use. With the same bits, all keys of a partition would lie in one part of
// its slots.
std::size_t CellSet::partition_of(std::uint64_t block) {
  return static_cast<std::size_t>((hash_key(block) >> 16) % kPartitions);
}

void CellSet::insert_keys(const std::vector<std::vector<std::uint64_t>>& parts, int num_threads) {
  const std::int64_t threads = std::min<std::int64_t>(resolve_num_threads(num_threads), kPartitions);
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    std::uint64_t previous = kEmptyKey;  // points along one ray often share a block
    std::uint64_t* mask = nullptr;
    for (const std::vector<std::uint64_t>& keys : parts) {
      for (const std::uint64_t key : keys) {
        const std::uint64_t block = CellBlocks::block_key(key);
        if (block != previous) {
          previous = block;
          const std::size_t number = partition_of(block);
          mask = nullptr;
          if (static_cast<std::int64_t>(number) % threads == task) {
            Partition& own = partitions_[number];
            std::int32_t found = own.numbers.find(block);
            if (found < 0) {
              own.masks.push_back(0);
              found = static_cast<std::int32_t>(own.masks.size()) - 1;
              own.numbers.insert(block, found);
            }
            mask = &own.masks[static_cast<std::size_t>(found)];
          }
        }
        if (mask != nullptr) *mask |= std::uint64_t{1} << (key & 63);
      }
    }
  });
}

template <typename T>
void CellSet::insert(const T* points, std::int64_t count, int num_threads) {
  std::vector<std::vector<std::uint64_t>> keys(1);
  keys[0].resize(static_cast<std::size_t>(count));
  cell_keys(points, count, leaf_size_m_, keys[0].data(), num_threads);
  insert_keys(keys, num_threads);
}

void CellSet::insert_rays(const float* points, const float* directions, std::int64_t count, double reach_m,
                          int num_threads) {
  check_rays(points, directions, count, leaf_size_m_, reach_m);
  constexpr std::int64_t kRays = 1 << 15;  // at a time: the keys of all would be much memory
  for (std::int64_t first = 0; first < count; first += kRays) {
    const std::int64_t size = std::min(kRays, count - first);
    const std::int64_t num_parts = std::min<std::int64_t>(resolve_num_threads(num_threads), size);
    std::vector<std::vector<std::uint64_t>> parts(static_cast<std::size_t>(num_parts));
    parallel_tasks(num_parts, num_threads, [&](std::int64_t part) {
      std::vector<std::uint64_t>& keys = parts[static_cast<std::size_t>(part)];
      for (std::int64_t i = first + size * part / num_parts; i < first + size * (part + 1) / num_parts; ++i) {
        CellWalk cell(points + 3 * i, directions + 3 * i, -reach_m, reach_m, leaf_size_m_);
        for (; cell.inside(); cell.next()) keys.push_back(cell.key());
      }
    });
    insert_keys(parts, num_threads);
  }
}

std::int64_t CellSet::size() const {
  std::int64_t total = 0;
  for (const Partition& partition : partitions_) {
    for (const std::uint64_t mask : partition.masks) total += count_bits(mask);
  }
  return total;
}

std::vector<std::uint64_t> CellSet::sorted_keys(int num_threads) const {
  std::vector<std::uint64_t> blocks;
  for (const Partition& partition : partitions_) {
    for (const Slot& slot : partition.numbers.slots()) {
      if (slot.key != kEmptyKey) blocks.push_back(slot.key);
    }
  }
  parallel_sort(blocks, num_threads);
  std::vector<std::uint64_t> keys;
  keys.reserve(static_cast<std::size_t>(size()));
  for (const std::uint64_t block : blocks) {
    const Partition& own = partitions_[partition_of(block)];
    std::uint64_t mask = own.masks[static_cast<std::size_t>(own.numbers.find(block))];
    for (; mask != 0; mask &= mask - 1) {
      keys.push_back(block << (3 * kBlockBits) | static_cast<std::uint64_t>(lowest_bit(mask)));
    }
  }
  return keys;
}

template void cell_keys(const float*, std::int64_t, double, std::uint64_t*, int);
template void cell_keys(const double*, std::int64_t, double, std::uint64_t*, int);
template void CellSet::insert(const float*, std::int64_t, int);
template void CellSet::insert(const double*, std::int64_t, int);

}  // namespace radarsdf
