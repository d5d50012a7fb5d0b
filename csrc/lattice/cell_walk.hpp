// Traversal of the cells along a line segment (Amanatides and Woo 1987). The intersection with a face of the lattice
// depends on that face alone, so a longer segment of the same line crosses all cells of a shorter one.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>

#include "lattice/cell.hpp"
#include "lattice/morton.hpp"

namespace radarsdf {

// A line in cells: position of its point, and steps along each axis.
struct CellLine {
  double position[3], cells_per_m[3], m_per_cell[3];  // negative for descending coordinates

  CellLine(const float* point, const float* direction, double cell_size_m) {
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] = point[axis] / cell_size_m;
      cells_per_m[axis] = direction[axis] / cell_size_m;
      m_per_cell[axis] = cells_per_m[axis] != 0 ? 1 / cells_per_m[axis] : std::numeric_limits<double>::infinity();
    }
  }
};

// Cells that contain point + t * direction for t in [from_m, to_m]: for (CellWalk cell(...); cell.inside();
// cell.next()). Call check_rays first.
//
// A step updates all three axes, two of them by zero. Selecting one by a branch or an index takes twice as long: the
// next step depends on it.
class CellWalk {
 public:
  CellWalk(const float* point, const float* direction, double from_m, double to_m, double cell_size_m,
           std::int32_t bias = kAxisBias)
      : CellWalk(CellLine(point, direction, cell_size_m), from_m, to_m, 1, bias) {}

  // edge: of the cells, in those of the line; a power of two, so that nothing is rounded. bias: offset of the
  // coordinates in keys; kAxisBias for leaf cells.
  CellWalk(const CellLine& line, double from_m, double to_m, double edge, std::int32_t bias) : to_m_(to_m) {
    const double per_edge = 1 / edge;
    for (int axis = 0; axis < 3; ++axis) {
      const double position = line.position[axis] * per_edge, cells_per_m = line.cells_per_m[axis] * per_edge;
      const double m_per_cell = line.m_per_cell[axis] * edge;
      const std::int32_t step = cells_per_m >= 0 ? 1 : -1, ahead = step > 0 ? 1 : 0;
      std::int32_t cell = floor_to_int(position + from_m * cells_per_m);
      // Rounding may start one cell too early.
      while ((cell + ahead - position) * m_per_cell < from_m) cell += step;
      Axis& way = axes_[axis];
      way = {position, m_per_cell, 0, cell + ahead, step, ahead, 0, 0};
      way.next_m = (way.face - position) * m_per_cell;
      way.key = spread_bits(static_cast<std::uint32_t>(cell + bias)) << axis;
      // A carry propagates through set bits of the other axes, a borrow through cleared ones.
      const std::uint64_t unit = std::uint64_t{1} << axis;
      way.key_step = step > 0 ? ~key_bits(axis) + unit : std::uint64_t{0} - unit;
    }
  }

  bool inside() const { return inside_; }
  std::int32_t coordinate(int axis) const { return axes_[axis].face - axes_[axis].ahead; }
  std::uint64_t key() const { return axes_[0].key | axes_[1].key | axes_[2].key; }

  // Distance at which the line leaves the cell.
  double leaves_m() const {
    // Of values, not std::min of references, which GCC compiles to branches.
    const double x_m = axes_[0].next_m, y_m = axes_[1].next_m, z_m = axes_[2].next_m, xy_m = y_m < x_m ? y_m : x_m;
    return z_m < xy_m ? z_m : xy_m;
  }

  void next() {
    const bool y_before_x = axes_[1].next_m < axes_[0].next_m;
    const double xy_m = y_before_x ? axes_[1].next_m : axes_[0].next_m;
    const bool z = axes_[2].next_m < xy_m;
    inside_ = (z ? axes_[2].next_m : xy_m) <= to_m_;
    advance(0, !z && !y_before_x);
    advance(1, !z && y_before_x);
    advance(2, z);
  }

 private:
  struct Axis {
    double position, m_per_cell;  // see CellLine
    double next_m;                // distance of the next face along the line
    std::int32_t face, step;      // cells
    std::int32_t ahead;           // 1 if coordinates ascend
    std::uint64_t key, key_step;  // bits of this axis; increment, with carry propagation
  };

  static constexpr std::uint64_t key_bits(int axis) { return std::uint64_t{0x1249249249249249} << axis; }

  void advance(int axis, bool moves) {
    Axis& way = axes_[axis];
    way.face += moves ? way.step : 0;
    way.next_m = (way.face - way.position) * way.m_per_cell;
    way.key = (way.key + (moves ? way.key_step : 0)) & key_bits(axis);
  }

  double to_m_;
  Axis axes_[3];
  bool inside_ = true;
};

// Throws std::invalid_argument unless all rays, from reach_m before to behind their points, lie within a million cells
// of the origin.
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
