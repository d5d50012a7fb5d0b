// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Sums over the returns in a cell, and over the cells round it.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell_blocks.hpp"

namespace radarsdf {

// Of a return at (x, y, z): 1, x, y, z, xx, xy, xz, yy, yz, zz, its direction's three components, and its range.
constexpr int kSums = 14;
constexpr double kDirectionQuanta = 1 << 24;  // in 1
// In the edge of a leaf cell: 3 um of 0.2 m, as float32 coordinates have at 50 m. Products of 1e8 returns have room.
constexpr std::int64_t kQuanta = 1 << 16;

// Halves to the even number, for sizes below 2^51. std::llrint is a call without -fno-math-errno.
inline std::int64_t rounded(double value) {
  constexpr double kShift = 6755399441055744;  // 1.5 * 2^52: floats there are whole numbers
  return static_cast<std::int64_t>((value + kShift) - kShift);
}

// What a return adds to the sums of a cell with this corner, in quanta; quanta: in 1 m. Unsigned, which may wrap
// around.
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

// Returns of scans, and the cell of each.
struct ReturnsInCells {
  const float* points;      // (count, 3), local frame, m
  const float* directions;  // (count, 3), unit vectors
  const float* ranges_m;    // (count,)
  const std::int32_t* cells;
  std::int64_t count;
};

// sums: (num_cells, kSums), over the returns of each cell, in integers, so that their order does not matter and some
// can be taken out again. Lengths are in quanta, from the corners (num_cells, 3) of the cells; directions in 1 /
// kDirectionQuanta. Sums wrap around: of products they mean nothing where a corner is far away.
void sum_returns(const ReturnsInCells& returns, const std::int64_t* corners, std::int64_t num_cells, double quantum_m,
                 std::int64_t* sums, int num_threads);

// From sums over the returns of leaf cells with these ascending keys, in quanta, those of the cells twice as large:
// their keys, ascending, and (keys, kSums - 1) numbers, without the range, of the local frame, in m.
struct Moments {
  std::vector<std::uint64_t> keys;
  std::vector<double> numbers;
};
Moments merge_sums(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m);

// The mean ray of each leaf cell: points (count, 3) and ranges_m (count,), local frame, m, unit directions (count, 3),
// downwards where the mean has no length, and the number of returns (count,).
struct MeanRays {
  float *points, *directions, *ranges_m, *counts;
};
void mean_rays(const std::uint64_t* keys, const std::int64_t* sums, std::int64_t count, double leaf_size_m,
               const MeanRays& means, int num_threads);

// sums: (count, columns), for each key those over its cell and the 26 round it of values, (cells.size(), columns). A
// cell that shares a face with the key's counts `weight` times, one that shares an edge weight^2, a corner weight^3.
// Many keys of a block are best given one after another, as they are in ascending order.
void neighbour_sums(const CellBlocks& cells, const std::uint64_t* keys, std::int64_t count, const double* values,
                    int columns, double weight, double* sums, int num_threads);

// interpolated: (count, columns), of values (cells.size(), columns) that belong to the centres of cells of this size,
// trilinear at points (count, 3), local frame, m; 0 where there is no cell. Throws std::invalid_argument for points
// without a key.
void interpolate_cells(const CellBlocks& cells, double cell_size_m, const float* values, int columns,
                       const float* points, std::int64_t count, float* interpolated, int num_threads);

}  // namespace radarsdf
