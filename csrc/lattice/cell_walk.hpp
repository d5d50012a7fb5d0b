// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The cells that a piece of a line goes through, in order (Amanatides and Woo 1987). Where the line meets a face of the
// lattice depends on that face alone, so a longer piece of the same line goes through all the cells of a shorter one.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>

#include "lattice/cell.hpp"
#include "lattice/morton.hpp"

namespace radarsdf {

// Calls visit(cell) with the lattice coordinates of each cell that point + t * direction is in for a t in [from_m,
// to_m]. check_rays comes first.
template <typename Visit>
void walk_cells(const float* point, const float* direction, double from_m, double to_m, double inverse_size,
                const Visit& visit) {
  double position[3], m_per_cell[3], next_m[3];
  std::int32_t cell[3], forward[3];
  const auto look_ahead = [&](int axis) {
    next_m[axis] = (cell[axis] + forward[axis] - position[axis]) * m_per_cell[axis];
  };
  for (int axis = 0; axis < 3; ++axis) {
    position[axis] = point[axis] * inverse_size;
    const double cells_per_m = direction[axis] * inverse_size;
    forward[axis] = cells_per_m >= 0 ? 1 : 0;
    cell[axis] = static_cast<std::int32_t>(std::floor(position[axis] + from_m * cells_per_m));
    m_per_cell[axis] = cells_per_m != 0 ? 1 / cells_per_m : std::numeric_limits<double>::infinity();
    look_ahead(axis);
    // Rounding may have put the beginning one cell too far back.
    while (next_m[axis] < from_m) {
      cell[axis] += 2 * forward[axis] - 1;
      look_ahead(axis);
    }
  }
  while (true) {
    visit(static_cast<const std::int32_t*>(cell));
    int axis = next_m[1] < next_m[0] ? 1 : 0;
    axis = next_m[2] < next_m[axis] ? 2 : axis;
    if (!(next_m[axis] <= to_m)) return;
    cell[axis] += 2 * forward[axis] - 1;
    look_ahead(axis);
  }
}

inline std::uint64_t lattice_key(const std::int32_t* cell) {
  return morton_key(static_cast<std::uint32_t>(cell[0] + kAxisBias), static_cast<std::uint32_t>(cell[1] + kAxisBias),
                    static_cast<std::uint32_t>(cell[2] + kAxisBias));
}

// Throws std::invalid_argument unless all rays, reach_m before and behind their points, lie within a million cells of
// the origin.
inline void check_rays(const float* points, const float* directions, std::int64_t count, double cell_size_m,
                       double reach_m) {
  const double limit_m = (kAxisBias - (1 << kMaxLevels)) * cell_size_m;
  bool inside = reach_m >= 0;
  for (std::int64_t i = 0; i < 3 * count; ++i) {  // NaN fails the comparison too
    inside = inside && std::abs(double{points[i]}) + reach_m * std::abs(double{directions[i]}) < limit_m;
  }
  if (!inside) throw std::invalid_argument("points must be finite and within a million cells of the origin");
}

}  // namespace radarsdf
