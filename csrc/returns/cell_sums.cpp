#include "returns/cell_sums.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <iterator>
#include <stdexcept>
#include <vector>

#include "lattice/cell.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/prefetch.hpp"

namespace radarsdf {
namespace {

constexpr std::int32_t kEdge = 1 << kBlockBits;

// A block and its halo of one cell: a cube of kWide cells per edge. Rows along x are padded, so that loops over them
// are vectorised.
constexpr std::int32_t kWide = kEdge + 2, kRow = 8, kSlice = kWide * kRow, kCube = kWide * kSlice;

constexpr int kFewColumns = 4;  // the only criterion, so that results do not depend on the set of requested keys

constexpr std::int32_t part_coordinate(int part, int axis) { return (part >> axis & 1) | (part >> (axis + 2) & 2); }

// For the 27 blocks of a neighbourhood: masks of the cells that touch the central block. `places`: positions of the
// cells of the central block in the cube; `inside`: in the block.
struct NextTo {
  std::uint64_t masks[27] = {};
  std::int32_t places[64] = {}, inside[64] = {};

  constexpr NextTo() {
    for (int part = 0; part < 64; ++part) {
      const std::int32_t at[3] = {part_coordinate(part, 0), part_coordinate(part, 1), part_coordinate(part, 2)};
      places[part] = kSlice * (at[2] + 1) + kRow * (at[1] + 1) + at[0] + 1;
      inside[part] = (kEdge * at[2] + at[1]) * kEdge + at[0];
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

// A block and its 26 neighbours, last coordinate fastest.
class BlockNeighbourhood {
 public:
  explicit BlockNeighbourhood(const CellBlocks& cells) : cells_(&cells) {}

  void move_to(std::uint64_t block_key) {
    const std::uint64_t region_key = CellBlocks::block_key(block_key);  // a region is a block of blocks
    if (region_key != region_key_) find_regions(region_key);
    int regions[3][3];  // of the 27, along each axis
    std::uint64_t parts[3][3];
    for (int axis = 0; axis < 3; ++axis) {
      for (int i = 0; i < 3; ++i) {
        const int at = part_coordinate(static_cast<int>(block_key & 63), axis) + i - 1;
        regions[axis][i] = (at + kEdge) / kEdge;
        parts[axis][i] = part_bits(at) << axis;
      }
    }
    count_ = 0;
    for (int x = 0, n = 0; x < 3; ++x) {
      for (int y = 0; y < 3; ++y) {
        const int row = 9 * regions[0][x] + 3 * regions[1][y];
        const std::uint64_t part = parts[0][x] | parts[1][y];
        for (int z = 0; z < 3; ++z, ++n) {
          const Occupancy* region = regions_[row + regions[2][z]];
          const Occupancy* block = region != nullptr ? cells_->block(*region, part | parts[2][z]) : nullptr;
          const std::uint64_t mask = block != nullptr ? block->mask & kNextTo.masks[n] : 0;
          if (mask != 0) near_[count_++] = {block, mask, kEdge * (x - 1 + kRow * (y - 1) + kSlice * (z - 1))};
        }
      }
    }
  }

  // Calls visit(row, place) for the cells of the central block and its halo; place is the position in the cube.
  template <typename Visit>
  void for_each(const Visit& visit) const {
    for (int i = 0; i < count_; ++i) {
      for (std::uint64_t bits = near_[i].mask; bits != 0; bits &= bits - 1) {
        const int part = lowest_bit(bits);
        visit(near_[i].block->row(static_cast<std::uint64_t>(part)), kNextTo.places[part] + near_[i].offset);
      }
    }
  }

 private:
  void find_regions(std::uint64_t region_key) {
    region_key_ = region_key;
    std::uint32_t at[3];
    for (int axis = 0; axis < 3; ++axis) at[axis] = morton_coordinate(region_key, axis) - 1;
    for (std::uint32_t i = 0; i < 27; ++i)
      regions_[i] = cells_->region(morton_key(at[0] + i / 9, at[1] + i / 3 % 3, at[2] + i % 3));
  }

  const CellBlocks* cells_;
  std::uint64_t region_key_ = kEmptyKey;
  const Occupancy* regions_[27] = {};  // around the region of the central block
  struct Near {
    const Occupancy* block;
    std::uint64_t mask;   // cells in the cube
    std::int32_t offset;  // of their places
  };
  Near near_[27] = {};  // blocks with such cells
  int count_ = 0;
};

// Separable neighbourhood sums for all cells of a block, axis by axis: (64, columns) in Morton order. With few columns
// this is less work than a sum for each key. `cube` is scratch.
class SumsOfBlock {
 public:
  SumsOfBlock(const double* values, int columns, double weight)
      : values_(values), columns_(columns), weight_(weight), sums_(64 * columns) {}

  void move_to(const BlockNeighbourhood& round) {
    std::int64_t first[kWide * kWide * kWide];  // value of each cell that is there
    std::int32_t places[kWide * kWide * kWide];
    int count = 0;
    round.for_each([&](std::int32_t row, std::int32_t place) {
      first[count] = columns_ * std::int64_t{row};
      places[count++] = place;
    });
    const auto add = [&](const double* from, int step, int size, double* to) {
      for (int i = 0; i < size; ++i) to[i] = weight_ * (from[i] + from[i + 2 * step]) + from[i + step];
    };
    for (int k = 0; k < columns_; ++k) {
      double cube[kCube] = {}, along_z[kEdge * kSlice], along_y[kEdge * kEdge * kRow];
      for (int i = 0; i < count; ++i) cube[places[i]] = values_[first[i] + k];
      for (int z = 0; z < kEdge; ++z) {
        add(cube + kSlice * z, kSlice, kSlice, along_z + kSlice * z);
        add(along_z + kSlice * z, kRow, kEdge * kRow, along_y + kEdge * kRow * z);
      }
      for (int row = 0; row < kEdge * kEdge; ++row)
        add(along_y + kRow * row, 1, kEdge, sums_.data() + 64 * k + kEdge * row);
    }
  }

  void copy(std::uint64_t key, double* own) const {
    const double* sum = sums_.data() + kNextTo.inside[key & 63];
    for (int k = 0; k < columns_; ++k) own[k] = sum[64 * k];
  }

 private:
  const double* values_;
  int columns_;
  double weight_;
  std::vector<double> sums_;  // (columns, 64), the first coordinate fastest
};

// Moves the origin of the sums `steps` back: (x + a)(y + b) sums to xy + a y + b x + a b.
template <typename T>
void move_moments(const T* steps, T* sums) {
  T* product = sums + 4;
  for (int i = 0; i < 3; ++i) {
    for (int j = i; j < 3; ++j, ++product)
      *product += steps[i] * sums[1 + j] + steps[j] * (sums[1 + i] + steps[i] * sums[0]);
  }
  for (int axis = 0; axis < 3; ++axis) sums[1 + axis] += steps[axis] * sums[0];
}

}  // namespace

void sum_returns(const ReturnsInCells& returns, const std::uint64_t* keys, std::int64_t num_cells, double leaf_size_m,
                 std::int64_t* sums, int num_threads) {
  constexpr std::int64_t kAhead = 16;  // returns: the cells of consecutive ones are rarely in the cache
  std::fill(sums, sums + kSums * num_cells, std::int64_t{0});
  const double quanta = 1 / (leaf_size_m / static_cast<double>(kQuanta));  // per metre
  // Every thread reads all returns and adds those of its own cells. Groups of cells are interleaved among threads to
  // balance the uneven density of returns.
  const std::int64_t threads = returns.count > (1 << 14) ? resolve_num_threads(num_threads) : 1;
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    for (std::int64_t i = 0; i < returns.count; ++i) {
      const std::int64_t cell = returns.cells[i], ahead = returns.cells[std::min(i + kAhead, returns.count - 1)];
      prefetch(keys + ahead);
      prefetch(sums + kSums * ahead);
      prefetch(sums + kSums * ahead + kSums - 1);
      if (threads > 1 && (cell >> 6) % threads != task) continue;  // a division takes as long as the rest of a return
      std::int64_t corner[3];
      for (int axis = 0; axis < 3; ++axis)
        corner[axis] = (std::int64_t{morton_coordinate(keys[cell], axis)} - kAxisBias) * kQuanta;
      std::uint64_t terms[kSums];
      sum_terms(returns.points + 3 * i, returns.directions + 3 * i, returns.ranges_m[i], corner, quanta, terms);
      const auto weight = static_cast<std::uint64_t>(returns.weights == nullptr ? 1 : returns.weights[i]);
      std::int64_t* own = sums + kSums * cell;
      for (int k = 0; k < kSums; ++k)
        own[k] = static_cast<std::int64_t>(static_cast<std::uint64_t>(own[k]) + weight * terms[k]);
    }
  });
}

Moments merge_sums(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m) {
  constexpr int kColumns = kSums - 1;
  const double quantum_m = leaf_size_m / static_cast<double>(kQuanta);
  Moments merged;
  std::int64_t total[kColumns];
  for (std::int64_t i = 0; i < count;) {
    const std::uint64_t parent = keys[i] >> 3;
    std::fill(total, total + kColumns, std::int64_t{0});
    for (; i < count && keys[i] >> 3 == parent; ++i) {
      // Shift to the corner of the parent cell: exact in integers.
      std::int64_t own[kColumns], steps[3];
      std::copy_n(sums + kSums * i, kColumns, own);
      for (int axis = 0; axis < 3; ++axis) steps[axis] = static_cast<std::int64_t>(keys[i] >> axis & 1) * kQuanta;
      move_moments(steps, own);
      for (int k = 0; k < kColumns; ++k) total[k] += own[k];
    }
    std::int32_t cell[3];
    double corner_m[3], numbers[kColumns];
    for (int axis = 0; axis < 3; ++axis) {
      cell[axis] = static_cast<std::int32_t>(morton_coordinate(parent, axis)) - kAxisBias / 2;
      corner_m[axis] = 2.0 * cell[axis] * static_cast<double>(kQuanta) * quantum_m;
    }
    for (int k = 0; k < kColumns; ++k) {
      const double unit = k == 0 ? 1 : k < 4 ? quantum_m : k < 10 ? quantum_m * quantum_m : 1 / kDirectionQuanta;
      numbers[k] = static_cast<double>(total[k]) * unit;
    }
    move_moments(corner_m, numbers);
    merged.keys.push_back(lattice_key(cell));
    merged.numbers.insert(merged.numbers.end(), numbers, numbers + kColumns);
  }
  return merged;
}

void mean_rays(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m,
               const MeanRays& means, int num_threads) {
  constexpr double kLeast = 1e-6;  // length of a mean of unit directions below which its direction is meaningless
  const double quantum_m = leaf_size_m / static_cast<double>(kQuanta);
  parallel_blocks(count, 1 << 13, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t* own = sums + kSums * i;
      const auto returns = static_cast<double>(own[0]);
      double direction[3], length2 = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const std::int64_t cell = static_cast<std::int32_t>(morton_coordinate(keys[i], axis)) - kAxisBias;
        const double quanta = static_cast<double>(own[1 + axis]) / returns + static_cast<double>(cell * kQuanta);
        means.points[3 * i + axis] = static_cast<float>(quanta * quantum_m);
        direction[axis] = static_cast<double>(own[10 + axis]) / (kDirectionQuanta * returns);
        length2 += direction[axis] * direction[axis];
      }
      const double length = std::sqrt(length2);
      for (int axis = 0; axis < 3; ++axis)
        means.directions[3 * i + axis] = length > kLeast ? static_cast<float>(direction[axis] / length)
                                         : axis == 2     ? -1.0F
                                                         : 0.0F;
      means.ranges_m[i] = static_cast<float>(static_cast<double>(own[13]) * quantum_m / returns);
      means.counts[i] = static_cast<float>(own[0]);
    }
  });
}

void neighbour_sums(const CellBlocks& cells, const std::uint64_t* keys, std::int64_t count, const double* values,
                    int columns, double weight, double* sums, int num_threads) {
  const double weights[4] = {1, weight, std::pow(weight, 2), std::pow(weight, 3)};
  const bool of_blocks = columns <= kFewColumns;
  parallel_blocks(count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    BlockNeighbourhood round(cells);
    SumsOfBlock block(values, of_blocks ? columns : 0, weight);
    std::uint64_t block_key = kEmptyKey;
    std::int32_t rows[kCube];
    for (std::int64_t i = begin; i < end; ++i) {
      double* own = sums + columns * i;
      if (CellBlocks::block_key(keys[i]) != block_key) {
        block_key = CellBlocks::block_key(keys[i]);
        round.move_to(block_key);
        if (of_blocks) {
          block.move_to(round);
        } else {
          std::fill(std::begin(rows), std::end(rows), -1);
          round.for_each([&](std::int32_t row, std::int32_t place) { rows[place] = row; });
        }
      }
      if (of_blocks) {
        block.copy(keys[i], own);
        continue;
      }
      std::fill_n(own, columns, 0.0);
      const std::int32_t* near = rows + kNextTo.places[keys[i] & 63];
      for (int x = -1; x <= 1; ++x) {
        for (int y = -1; y <= 1; ++y) {
          for (int z = -1; z <= 1; ++z) {
            const std::int32_t row = near[x + kRow * y + kSlice * z];
            if (row < 0) continue;
            const double w = weights[x * x + y * y + z * z];
            for (int k = 0; k < columns; ++k) own[k] += w * values[columns * std::int64_t{row} + k];
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
    // Of the previous point: vertices of a mesh mostly lie between the same cells.
    std::int32_t last[3] = {-1, -1, -1};
    std::int64_t near[8];
    for (std::int64_t i = begin; i < end; ++i) {
      float share[3];
      std::int32_t lower[3];
      for (int axis = 0; axis < 3; ++axis) {
        const float u = points[3 * i + axis] / size_m - 0.5F;
        if (!(std::abs(u) < static_cast<float>(kAxisBias - (1 << kMaxLevels)))) {
          inside = false;
          return;
        }
        const std::int32_t whole = floor_to_int(u);
        share[axis] = u - static_cast<float>(whole);
        lower[axis] = whole + kAxisBias;
      }
      if (!std::equal(lower, lower + 3, last)) {
        std::copy_n(lower, 3, last);
        std::uint64_t parts[3][2];  // key bits of the lower and the upper cell along each axis
        for (int axis = 0; axis < 3; ++axis)
          for (std::uint32_t step = 0; step < 2; ++step)
            parts[axis][step] = spread_bits(static_cast<std::uint32_t>(lower[axis]) + step) << axis;
        for (int corner = 0; corner < 8; ++corner)
          near[corner] = rows.row(parts[0][corner >> 2] | parts[1][corner >> 1 & 1] | parts[2][corner & 1]);
      }
      const float x[2] = {1 - share[0], share[0]}, y[2] = {1 - share[1], share[1]}, z[2] = {1 - share[2], share[2]};
      float* to = interpolated + columns * i;
      std::fill_n(to, columns, 0.0F);
      for (int corner = 0; corner < 8; ++corner) {
        if (near[corner] < 0) continue;
        const float weight = x[corner >> 2] * y[corner >> 1 & 1] * z[corner & 1];
        for (int k = 0; k < columns; ++k) to[k] += weight * values[columns * near[corner] + k];
      }
    }
  });
  if (!inside) throw std::invalid_argument("points must be finite and within a million cells of the origin");
}

}  // namespace radarsdf
