// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Sums over the returns in a cell, and over the cells round it.
#pragma once

#include <cstdint>

#include "lattice/cell_blocks.hpp"

namespace radarsdf {

// Of a return at (x, y, z): 1, x, y, z, xx, xy, xz, yy, yz, zz, and its direction's three components.
constexpr int kMoments = 13;

// moments: (num_cells, kMoments), the sums over the returns of each cell, in the order of the returns. points,
// directions: (count, 3), local frame, m; cells: the cell of each.
void sum_moments(const float* points, const float* directions, const std::int32_t* cells, std::int64_t count,
                 std::int64_t num_cells, double* moments, int num_threads);

// sums: (count, columns), for each key those over its cell and the 26 round it of values, (cells.size(), columns). A
// cell that shares a face with the key's counts `weight` times, one that shares an edge weight^2, a corner weight^3.
// Many keys of a block are best given one after another, as they are in ascending order.
void sum_round(const CellBlocks& cells, const std::uint64_t* keys, std::int64_t count, const double* values,
               int columns, double weight, double* sums, int num_threads);

// interpolated: (count, columns), of values (cells.size(), columns) that belong to the centres of cells of this size,
// trilinear at points (count, 3), local frame, m; 0 where there is no cell. Throws std::invalid_argument for points
// without a key.
void interpolate_cells(const CellBlocks& cells, double cell_size_m, const float* values, int columns,
                       const float* points, std::int64_t count, float* interpolated, int num_threads);

}  // namespace radarsdf
