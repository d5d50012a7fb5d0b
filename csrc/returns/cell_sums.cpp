// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/cell_sums.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "lattice/cell.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int32_t kEdge = 1 << kBlockBits;

constexpr std::int32_t kWide = kEdge + 2;

constexpr std::int32_t part_coordinate(int part, int axis) { return (part >> axis & 1) | (part >> (axis + 2) & 2); }

// Of the 27 blocks round one: which of their cells touch it; and where the cells of the one itself lie in the cube of
// kWide cells round it.
struct NextTo {
  std::uint64_t masks[27] = {};
  std::int32_t places[64] = {};

  constexpr NextTo() {
    for (int part = 0; part < 64; ++part) {
      const std::int32_t at[3] = {part_coordinate(part, 0), part_coordinate(part, 1), part_coordinate(part, 2)};
      places[part] = (kWide * (at[0] + 1) + at[1] + 1) * kWide + at[2] + 1;
      for (int n = 0; n < 27; ++n) {
        const int steps[3] = {n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1};
        bool touches = true;
        for (int axis = 0; axis < 3; ++axis) {
          if (steps[axis] != 0) touches = touches && at[axis] == (steps[axis] > 0 ? 0 : kEdge - 1);
        }
        if (touches) masks[n] |= std::uint64_t{1} << part;
      }
    }
  }
};
constexpr NextTo kNextTo;

// The 27 blocks round one, the last coordinate fastest.
class BlocksRound {
 public:
  explicit BlocksRound(const CellBlocks& cells) : cells_(&cells) {}

  void move_to(std::uint64_t block_key) {
    if (block_key == block_key_) return;
    block_key_ = block_key;
    std::uint64_t parts[3][3];
    for (int axis = 0; axis < 3; ++axis) {
      const std::uint32_t coordinate = morton_coordinate(block_key, axis);
      for (std::uint32_t i = 0; i < 3; ++i) parts[axis][i] = spread_bits(coordinate + i - 1) << axis;
    }
    for (int i = 0; i < 27; ++i) {
      const std::uint64_t key = parts[0][i / 9] | parts[1][i / 3 % 3] | parts[2][i % 3];
      const std::uint64_t region_key = key >> (3 * (kRegionBits - kBlockBits));
      if (region_key != region_key_) {  // often it is the same
        region_key_ = region_key;
        region_ = cells_->region(region_key);
      }
      blocks_[i] = region_ != nullptr ? cells_->block(*region_, key) : nullptr;
    }
  }

  // Calls visit(row, place) for the cells of the middle block and those next to it; place is the position in a cube of
  // 6 x 6 x 6 cells, the last coordinate fastest.
  template <typename Visit>
  void for_each(const Visit& visit) const {
    for (int n = 0; n < 27; ++n) {
      if (blocks_[n] == nullptr) continue;
      const int offset = kEdge * (kWide * kWide * (n / 9 - 1) + kWide * (n / 3 % 3 - 1) + n % 3 - 1);
      for (std::uint64_t bits = blocks_[n]->mask & kNextTo.masks[n]; bits != 0; bits &= bits - 1) {
        const int part = lowest_bit(bits);
        visit(blocks_[n]->row(static_cast<std::uint64_t>(part)), kNextTo.places[part] + offset);
      }
    }
  }

  // The row of the cell at these coordinates, counted from the middle block's first cell; -1 where there is none.
  std::int32_t row(std::int32_t x, std::int32_t y, std::int32_t z) const {
    const auto block = [](std::int32_t v) { return (v + kEdge) >> kBlockBits; };
    const Occupancy* found = blocks_[9 * block(x) + 3 * block(y) + block(z)];
    if (found == nullptr) return -1;
    return found->row(child_[x & 3] | child_[y & 3] << 1 | child_[z & 3] << 2);
  }

 private:
  static constexpr std::uint64_t child_[kEdge] = {0, 1, 8, 9};  // spread_bits of 0 to 3

  const CellBlocks* cells_;
  std::uint64_t block_key_ = kEmptyKey, region_key_ = kEmptyKey;
  const Occupancy* region_ = nullptr;
  const Occupancy* blocks_[27] = {};
};

// From how many keys in a block on it is less work to add up round all 64, axis after axis.
constexpr std::int64_t kManyKeys = 5;

// sums: (64, columns), in Morton order, of the values in the 27 cells round each of a block's. `cube` is scratch.
void neighbour_sums_of_block(const BlocksRound& round, const double* values, int columns, std::vector<double>& cube,
                             double* sums) {
  constexpr std::int32_t kPlaces = kWide * kWide * kWide;
  cube.assign(static_cast<std::size_t>(kPlaces * columns), 0.0);
  round.for_each([&](std::int32_t row, std::int32_t place) {
    for (int k = 0; k < columns; ++k) {
      cube[static_cast<std::size_t>(kPlaces * k + place)] = values[columns * std::int64_t{row} + k];
    }
  });
  for (int k = 0; k < columns; ++k) {
    double along_z[kWide][kWide][kEdge], along_y[kWide][kEdge][kEdge];
    for (std::int32_t x = 0; x < kWide; ++x) {
      for (std::int32_t y = 0; y < kWide; ++y) {
        const double* line = &cube[static_cast<std::size_t>(kPlaces * k + (kWide * x + y) * kWide)];
        for (std::int32_t z = 0; z < kEdge; ++z) along_z[x][y][z] = line[z] + line[z + 1] + line[z + 2];
      }
      for (std::int32_t y = 0; y < kEdge; ++y) {
        for (std::int32_t z = 0; z < kEdge; ++z) {
          along_y[x][y][z] = along_z[x][y][z] + along_z[x][y + 1][z] + along_z[x][y + 2][z];
        }
      }
    }
    for (int i = 0; i < 64; ++i) {
      const std::int32_t x = part_coordinate(i, 0), y = part_coordinate(i, 1), z = part_coordinate(i, 2);
      sums[columns * std::int64_t{i} + k] = along_y[x][y][z] + along_y[x + 1][y][z] + along_y[x + 2][y][z];
    }
  }
}

// Whether more than kManyKeys of the ascending keys round keys[i] lie in its block: it depends on the keys alone.
bool in_crowd(const std::uint64_t* keys, std::int64_t count, std::int64_t i) {
  const std::uint64_t block_key = CellBlocks::block_key(keys[i]);
  std::int64_t found = 0;
  for (std::int64_t k = i; k >= 0 && found <= kManyKeys && CellBlocks::block_key(keys[k]) == block_key; --k) ++found;
  for (std::int64_t k = i + 1; k < count && found <= kManyKeys && CellBlocks::block_key(keys[k]) == block_key; ++k)
    ++found;
  return found > kManyKeys;
}

}  // namespace

void sum_returns(const ReturnsInCells& returns, const std::int64_t* corners, std::int64_t num_cells, double quantum_m,
                 std::int64_t* sums, int num_threads) {
  std::fill(sums, sums + kSums * num_cells, std::int64_t{0});
  const double quanta = 1 / quantum_m;  // in 1 m
  // Every thread reads all returns and adds those of its own cells. These are scattered, since returns are denser in
  // some places than in others.
  const std::int64_t threads = returns.count > (1 << 14) ? resolve_num_threads(num_threads) : 1;
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    for (std::int64_t i = 0; i < returns.count; ++i) {
      const std::int64_t cell = returns.cells[i];
      if ((cell >> 6) % threads != task) continue;
      std::uint64_t terms[kSums];
      sum_terms(returns.points + 3 * i, returns.directions + 3 * i, returns.ranges_m[i], corners + 3 * cell, quanta,
                terms);
      std::int64_t* own = sums + kSums * cell;
      for (int k = 0; k < kSums; ++k) own[k] = static_cast<std::int64_t>(static_cast<std::uint64_t>(own[k]) + terms[k]);
    }
  });
}

void neighbour_sums(const CellBlocks& cells, const std::uint64_t* keys, std::int64_t count, const double* values,
                    int columns, double weight, double* sums, int num_threads) {
  const double weights[4] = {1, weight, std::pow(weight, 2), std::pow(weight, 3)};
  std::fill(sums, sums + columns * count, 0.0);
  parallel_blocks(count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    BlocksRound round(cells);
    std::uint64_t block_key = kEmptyKey;
    bool add_up_block = false;
    std::vector<double> block_sums(static_cast<std::size_t>(64 * columns)), cube;
    for (std::int64_t i = begin; i < end; ++i) {
      if (CellBlocks::block_key(keys[i]) != block_key) {
        block_key = CellBlocks::block_key(keys[i]);
        round.move_to(block_key);
        add_up_block = weight == 1 && in_crowd(keys, count, i);
        if (add_up_block) neighbour_sums_of_block(round, values, columns, cube, block_sums.data());
      }
      if (add_up_block) {
        const double* own = block_sums.data() + columns * static_cast<std::int64_t>(keys[i] & 63);
        std::copy(own, own + columns, sums + columns * i);
        continue;
      }
      std::int32_t cell[3];
      for (int axis = 0; axis < 3; ++axis) {
        cell[axis] = static_cast<std::int32_t>(morton_coordinate(keys[i], axis)) & (kEdge - 1);
      }
      for (int x = -1; x <= 1; ++x) {
        for (int y = -1; y <= 1; ++y) {
          for (int z = -1; z <= 1; ++z) {
            const std::int32_t row = round.row(cell[0] + x, cell[1] + y, cell[2] + z);
            if (row < 0) continue;
            const double w = weights[x * x + y * y + z * z];
            for (int k = 0; k < columns; ++k) sums[columns * i + k] += w * values[columns * std::int64_t{row} + k];
          }
        }
      }
    }
  });
}

void interpolate_cells(const CellBlocks& cells, double cell_size_m, const float* values, int columns,
                       const float* points, std::int64_t count, float* interpolated, int num_threads) {
  const auto size_m = static_cast<float>(cell_size_m);
  std::atomic<bool> inside{true};
  parallel_blocks(count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    NearbyRows rows(cells);
    for (std::int64_t i = begin; i < end; ++i) {
      float share[3];
      std::int32_t lower[3];
      std::uint64_t parts[3][2];  // of keys
      for (int axis = 0; axis < 3; ++axis) {
        const float u = points[3 * i + axis] / size_m - 0.5F;
        if (!(std::abs(u) < static_cast<float>(kAxisBias - (1 << kMaxLevels)))) {
          inside = false;
          return;
        }
        const float whole = std::floor(u);
        share[axis] = u - whole;
        lower[axis] = static_cast<std::int32_t>(whole) + kAxisBias;
        for (std::uint32_t step = 0; step < 2; ++step) {
          parts[axis][step] = spread_bits(static_cast<std::uint32_t>(lower[axis]) + step) << axis;
        }
      }
      float* sums = interpolated + columns * i;
      std::fill(sums, sums + columns, 0.0F);
      for (int corner = 0; corner < 8; ++corner) {
        float weight = 1;
        std::uint64_t key = 0;
        for (int axis = 0; axis < 3; ++axis) {
          const int step = corner >> (2 - axis) & 1;
          weight *= step != 0 ? share[axis] : 1 - share[axis];
          key |= parts[axis][step];
        }
        const std::int32_t row = rows.row(key);
        if (row < 0) continue;
        for (int k = 0; k < columns; ++k) sums[k] += weight * values[columns * std::int64_t{row} + k];
      }
    }
  });
  if (!inside) throw std::invalid_argument("points must be finite and within a million cells of the origin");
}

}  // namespace radarsdf
