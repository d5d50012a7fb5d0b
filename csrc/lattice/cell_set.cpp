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
#include "util/sorting.hpp"

namespace radarsdf {
namespace {

constexpr const char* kOutside = "points must be finite and within a million cells of the origin";

template <typename T>
class LatticeOf {
 public:
  explicit LatticeOf(double leaf_size_m) : inverse_(static_cast<T>(1.0 / leaf_size_m)) {}

  bool holds(const T* point) const {  // NaN fails the comparison too
    return std::abs(point[0] * inverse_) < limit_ && std::abs(point[1] * inverse_) < limit_ &&
           std::abs(point[2] * inverse_) < limit_;
  }

  void check(const T* points, std::int64_t count, int num_threads) const {
    std::atomic<bool> inside{true};
    parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
      bool all = true;
      for (std::int64_t i = 3 * begin; i < 3 * end; ++i) all = all & (std::abs(points[i] * inverse_) < limit_);
      if (!all) inside = false;
    });
    if (!inside) throw std::invalid_argument(kOutside);
  }

  void cell(const T* point, std::int32_t* cell) const {  // requires holds(point)
    for (int axis = 0; axis < 3; ++axis) cell[axis] = floor_to_int(point[axis] * inverse_);
  }

 private:
  T inverse_;
  // The far vertex of the last cell must be inside at every level.
  static constexpr T limit_ = static_cast<T>(kAxisBias - (1 << kMaxLevels));
};

}  // namespace

CellSet::CellSet(double leaf_size_m) : leaf_size_m_(leaf_size_m) {
  if (!(leaf_size_m > 0) || !std::isfinite(leaf_size_m))
    throw std::invalid_argument("leaf_size_m must be positive and finite");
}

template <typename T>
void cell_keys(const T* points, std::int64_t count, double leaf_size_m, std::uint64_t* keys, int num_threads) {
  const LatticeOf<T> lattice(leaf_size_m);
  lattice.check(points, count, num_threads);
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::int32_t cell[3];
      lattice.cell(points + 3 * i, cell);
      keys[i] = lattice_key(cell);
    }
  });
}

// Uses bits of the hash that FlatMap does not. With the same bits, all keys of a partition would cluster in one part of
// its slots.
std::size_t CellSet::partition_of(std::uint64_t block) { return (hash_key(block) >> 16) % kPartitions; }

class CellSet::Marks {
 public:
  void add(const std::int32_t* cell) {
    bool moved = false;
    for (int axis = 0; axis < 3; ++axis) moved = moved || cell[axis] >> kBlockBits != block_[axis];
    if (moved) {  // consecutive cells along a ray often share a block
      finish();
      for (int axis = 0; axis < 3; ++axis) block_[axis] = cell[axis] >> kBlockBits;
    }
    mask_ |= std::uint64_t{1} << part_of(cell);
  }

  void finish() {
    if (mask_ == 0) return;
    const std::uint64_t key = lattice_key(block_, kAxisBias >> kBlockBits);
    of_partitions_[partition_of(key)].push_back({key, mask_});
    mask_ = 0;
  }

  void clear() {
    for (auto& entries : of_partitions_) entries.clear();
  }

  struct Entry {
    std::uint64_t block, mask;
  };
  const std::vector<Entry>& of_partition(std::int64_t number) const { return of_partitions_[number]; }

 private:
  std::array<std::vector<Entry>, kPartitions> of_partitions_;
  std::int32_t block_[3] = {};
  std::uint64_t mask_ = 0;
};

template <typename Mark>
void CellSet::insert_marks(std::int64_t count, int num_threads, const Mark& mark) {
  constexpr std::int64_t kAtOnce = 1 << 18;  // bounds the memory for marks
  const std::int64_t num_parts = std::min<std::int64_t>(resolve_num_threads(num_threads), kPartitions);
  std::vector<Marks> parts(num_parts);
  for (std::int64_t first = 0; first < count; first += kAtOnce) {
    const std::int64_t size = std::min(kAtOnce, count - first);
    parallel_tasks(num_parts, num_threads, [&](std::int64_t part) {
      Marks& own = parts[part];
      own.clear();
      mark(first + size * part / num_parts, first + size * (part + 1) / num_parts, own);
      own.finish();
    });
    parallel_tasks(num_parts, num_threads, [&](std::int64_t task) {
      for (std::int64_t p = kPartitions * task / num_parts; p < kPartitions * (task + 1) / num_parts; ++p) {
        Partition& own = partitions_[p];
        for (const Marks& marks : parts) {
          for (const Marks::Entry& entry : marks.of_partition(p)) {
            const auto next = static_cast<std::int32_t>(own.masks.size());
            const std::int32_t found = own.numbers.find_or_insert(entry.block, next);
            if (found == next) own.masks.push_back(0);
            own.masks[found] |= entry.mask;
          }
        }
      }
    });
  }
}

template <typename T>
void CellSet::insert(const T* points, std::int64_t count, int num_threads) {
  const LatticeOf<T> lattice(leaf_size_m_);
  lattice.check(points, count, num_threads);
  insert_marks(count, num_threads, [&](std::int64_t begin, std::int64_t end, Marks& marks) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::int32_t cell[3];
      lattice.cell(points + 3 * i, cell);
      marks.add(cell);
    }
  });
}

void CellSet::insert_along(const float* points, const float* directions, std::int64_t count, const float* offsets_m,
                           std::int64_t num_offsets, int num_threads) {
  const LatticeOf<float> lattice(leaf_size_m_);
  std::atomic<bool> inside{true};
  insert_marks(count, num_threads, [&](std::int64_t begin, std::int64_t end, Marks& marks) {
    for (std::int64_t i = begin; i < end; ++i) {
      for (std::int64_t k = 0; k < num_offsets; ++k) {
        float at[3];
        for (int axis = 0; axis < 3; ++axis) at[axis] = points[3 * i + axis] + offsets_m[k] * directions[3 * i + axis];
        if (!lattice.holds(at)) {
          inside = false;
          return;
        }
        std::int32_t cell[3];
        lattice.cell(at, cell);
        marks.add(cell);
      }
    }
  });
  if (!inside) throw std::invalid_argument(kOutside);
}

void CellSet::insert_rays(const float* points, const float* directions, std::int64_t count, double reach_m,
                          int num_threads) {
  check_rays(points, directions, count, leaf_size_m_, reach_m);
  insert_marks(count, num_threads, [&](std::int64_t begin, std::int64_t end, Marks& marks) {
    for (std::int64_t i = begin; i < end; ++i) {
      CellWalk cell(points + 3 * i, directions + 3 * i, -reach_m, reach_m, leaf_size_m_);
      for (; cell.inside(); cell.next()) {
        const std::int32_t at[3] = {cell.coordinate(0), cell.coordinate(1), cell.coordinate(2)};
        marks.add(at);
      }
    }
  });
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
  keys.reserve(size());
  for (const std::uint64_t block : blocks) {
    const Partition& own = partitions_[partition_of(block)];
    std::uint64_t mask = own.masks[own.numbers.find(block)];
    for (; mask != 0; mask &= mask - 1) {
      keys.push_back(CellBlocks::key_in_block(block, lowest_bit(mask)));
    }
  }
  return keys;
}

template void cell_keys(const float*, std::int64_t, double, std::uint64_t*, int);
template void cell_keys(const double*, std::int64_t, double, std::uint64_t*, int);
template void CellSet::insert(const float*, std::int64_t, int);
template void CellSet::insert(const double*, std::int64_t, int);

}  // namespace radarsdf
