// Sums over the returns of cells, and over their neighbourhoods.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell_blocks.hpp"

namespace radarsdf {

// Summands of a return at (x, y, z): 1, x, y, z, xx, xy, xz, yy, yz, zz, the direction (3), and the range.
constexpr int kSums = 14;
constexpr double kDirectionQuanta = 1 << 24;  // per unit
// Per edge of a leaf cell: 3 um at 0.2 m, the resolution of float32 at 50 m. Products of 1e8 returns do not overflow.
constexpr std::int64_t kQuanta = 1 << 16;

// Rounds half to even, for magnitudes below 2^51. std::llrint is a call without -fno-math-errno.
inline std::int64_t rounded(double value) {
  constexpr double kShift = 6755399441055744;  // 1.5 * 2^52: doubles there are integers
  return static_cast<std::int64_t>((value + kShift) - kShift);
}

// Summands of a return in a cell with this corner, in quanta; quanta: per m. Unsigned, since they may wrap around.
inline void sum_terms(const float* point, const float* direction, float range_m, const std::int64_t* corner,
                      double quanta, std::uint64_t* terms) {
  std::uint64_t place[3];
  for (int axis = 0; axis < 3; ++axis) {
    place[axis] = static_cast<std::uint64_t>(rounded(quanta * point[axis]) - corner[axis]);
    terms[10 + axis] = static_cast<std::uint64_t>(rounded(kDirectionQuanta * direction[axis]));
  }
  const std::uint64_t x = place[0], y = place[1], z = place[2];
  const std::uint64_t of_place[10] = {1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
  for (int k = 0; k < 10; ++k) terms[k] = of_place[k];
  terms[13] = static_cast<std::uint64_t>(rounded(quanta * range_m));
}

// Returns of scans, and their cells.
struct ReturnsInCells {
  const float* points;      // (count, 3), local frame, m
  const float* directions;  // (count, 3), unit vectors
  const float* ranges_m;    // (count,)
  const std::int32_t* cells;
  std::int64_t count;
  const std::int32_t* weights = nullptr;  // nullptr: all are 1
};

// sums: (num_cells, kSums), integer weighted sums over the returns of each cell with Morton keys (num_cells),
// independent of their order and exactly reversible. Lengths are in quanta, relative to the corners of the cells;
// directions in 1 / kDirectionQuanta. Sums wrap around: those of products are invalid for a return far from its cell.
void sum_returns(const ReturnsInCells& returns, const std::uint64_t* keys, std::int64_t num_cells, double leaf_size_m,
                 std::int64_t* sums, int num_threads);

// Merges sums of leaf cells with ascending keys, in quanta, to those of the cells twice as large: ascending keys, and
// sums (keys, kSums - 1), without the range, in the local frame, m.
struct Moments {
  std::vector<std::uint64_t> keys;
  std::vector<double> numbers;
};
Moments merge_sums(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m);

// Mean ray of each leaf cell: points (count, 3) and ranges_m (count,), local frame, m, unit directions (count, 3),
// downwards if the mean is zero, and the number of returns (count,).
struct MeanRays {
  float *points, *directions, *ranges_m, *counts;
};
void mean_rays(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m,
               const MeanRays& means, int num_threads);

// sums: (count, columns), weighted sums of values (cells.size(), columns) over each key's cell and its 26 neighbours. A
// neighbour has `weight` if it shares a face, weight^2 for an edge, weight^3 for a corner. Ascending keys are fastest,
// since those of a block are consecutive.
void neighbour_sums(const CellBlocks& cells, const std::uint64_t* keys, std::int64_t count, const double* values,
                    int columns, double weight, double* sums, int num_threads);

// interpolated: (count, columns), trilinear interpolation of values (cells.size(), columns) at cell centres to points
// (count, 3), local frame, m; missing cells count as 0. Throws std::invalid_argument for points without a key.
void interpolate_cells(const CellBlocks& cells, double cell_size_m, const float* values, int columns,
                       const float* points, std::int64_t count, float* interpolated, int num_threads);

}  // namespace radarsdf
