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

// Cells that point + t * direction is in for a t in [from_m, to_m]: for (CellWalk cell(...); cell.inside();
// cell.next()). check_rays comes first.
class CellWalk {
 public:
  // bias: of the keys, as kAxisBias is that of leaf cells.
  CellWalk(const float* point, const float* direction, double from_m, double to_m, double cell_size_m,
           std::int32_t bias = kAxisBias)
      : to_m_(to_m) {
    for (int axis = 0; axis < 3; ++axis) {
      position_[axis] = point[axis] / cell_size_m;
      const double cells_per_m = direction[axis] / cell_size_m;
      step_[axis] = cells_per_m >= 0 ? 1 : -1;
      cell_[axis] = static_cast<std::int32_t>(std::floor(position_[axis] + from_m * cells_per_m));
      m_per_cell_[axis] = cells_per_m != 0 ? 1 / cells_per_m : std::numeric_limits<double>::infinity();
      look_ahead(axis);
      // Rounding may have put the beginning one cell too far back.
      while (next_m_[axis] < from_m) {
        cell_[axis] += step_[axis];
        look_ahead(axis);
      }
    }
    key_ = lattice_key(cell_, bias);
  }

  bool inside() const { return inside_; }
  std::int32_t coordinate(int axis) const { return cell_[axis]; }
  std::uint64_t key() const { return key_; }
  double leaves_m() const { return next_m_[nearest_axis()]; }  ///< where the line leaves the cell

  void next() {
    const int axis = nearest_axis();
    inside_ = next_m_[axis] <= to_m_;
    cell_[axis] += step_[axis];
    key_ = morton_neighbour(key_, axis, step_[axis]);
    look_ahead(axis);
  }

 private:
  int nearest_axis() const {
    const int axis = next_m_[1] < next_m_[0] ? 1 : 0;
    return next_m_[2] < next_m_[axis] ? 2 : axis;
  }

  void look_ahead(int axis) {
    next_m_[axis] = (cell_[axis] + (step_[axis] > 0 ? 1 : 0) - position_[axis]) * m_per_cell_[axis];
  }

  double to_m_, position_[3], m_per_cell_[3], next_m_[3];
  std::int32_t cell_[3], step_[3];
  std::uint64_t key_;
  bool inside_ = true;
};

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
