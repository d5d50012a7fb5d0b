// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "surface_crossings.hpp"

#include <cmath>
#include <limits>
#include <stdexcept>

#include "morton.hpp"
#include "parallel.hpp"

namespace radarsdf {
namespace {

constexpr float kSlack = 0.25F;  // of a cell: planes of neighbours do not quite meet at their common face

// Walks the cells along a ray in order (Amanatides and Woo 1987), in cells' units.
class CellWalk {
 public:
  CellWalk(const double* start, const double* direction, double cell_size_m) {
    for (int axis = 0; axis < 3; ++axis) {
      const double u = start[axis] / cell_size_m, cell = std::floor(u);
      coordinate_[axis] = static_cast<std::uint32_t>(static_cast<std::int32_t>(cell) + kAxisBias);
      step_[axis] = direction[axis] >= 0 ? 1 : ~std::uint32_t{0};
      const double speed = std::abs(direction[axis]) / cell_size_m, infinity = std::numeric_limits<double>::infinity();
      per_cell_m_[axis] = speed > 0 ? 1 / speed : infinity;
      next_m_[axis] = speed > 0 ? (direction[axis] >= 0 ? cell + 1 - u : u - cell) / speed : infinity;
      key_[axis] = spread_bits(coordinate_[axis]) << axis;
    }
  }

  std::uint64_t key() const { return key_[0] | key_[1] | key_[2]; }
  double end_m() const { return next_m_[nearest_axis()]; }  ///< where the ray leaves the cell

  void advance() {
    const int axis = nearest_axis();
    coordinate_[axis] += step_[axis];
    key_[axis] = spread_bits(coordinate_[axis]) << axis;
    next_m_[axis] += per_cell_m_[axis];
  }

 private:
  int nearest_axis() const {
    const int axis = next_m_[1] < next_m_[0] ? 1 : 0;
    return next_m_[2] < next_m_[axis] ? 2 : axis;
  }

  std::uint32_t coordinate_[3] = {}, step_[3] = {};
  std::uint64_t key_[3] = {};
  double per_cell_m_[3] = {}, next_m_[3] = {};
};

}  // namespace

SurfelMap::SurfelMap(const std::uint64_t* keys, const Surfel* surfels, std::int64_t count, double cell_size_m)
    : cell_size_m_(cell_size_m), cells_(static_cast<std::size_t>(count)), surfels_(surfels, surfels + count) {
  if (!(cell_size_m > 0) || !std::isfinite(cell_size_m)) {
    throw std::invalid_argument("cell_size_m must be positive and finite");
  }
  for (std::int64_t i = 0; i < count; ++i) cells_.insert(keys[i], static_cast<std::int32_t>(i));
}

void SurfelMap::first_crossings(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                                BeamNoise noise, float margin_m, float sigmas, std::int32_t* crossed,
                                int num_threads) const {
  const FlatMapView cells = cells_.view();
  const double slack_m = kSlack * cell_size_m_;
  const double limit_m = (kAxisBias - 1) * cell_size_m_;  // NaN fails the comparison too

  // Whether the ray i crosses the surfel's plane between begin_m and end_m and ends well behind it.
  const auto crosses = [&](std::int64_t i, const Surfel& surfel, double begin_m, double end_m) {
    const float *p = points + 3 * i, *d = directions + 3 * i, *n = surfel.normal, *c = surfel.centre;
    const float cosine = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
    const float depth_m = -(n[0] * (p[0] - c[0]) + n[1] * (p[1] - c[1]) + n[2] * (p[2] - c[2]));
    if (!(cosine > 0) || depth_m <= margin_m) return false;
    const double at_m = ranges_m[i] - depth_m / cosine;
    if (at_m < begin_m - slack_m || at_m > end_m + slack_m) return false;
    const float along = noise.range_m * cosine, across = noise.angle_rad * ranges_m[i];
    const float variance =
        along * along + across * across * (1 - cosine * cosine) + surfel.thickness * surfel.thickness;
    return depth_m > margin_m + sigmas * std::sqrt(variance);
  };

  parallel_blocks(count, 1 << 10, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      crossed[i] = -1;
      const double range_m = ranges_m[i];
      double start[3], direction[3];
      bool inside = range_m > 0 && range_m < limit_m;
      for (int axis = 0; axis < 3; ++axis) {
        direction[axis] = directions[3 * i + axis];
        start[axis] = points[3 * i + axis] - range_m * direction[axis];
        inside = inside && std::abs(start[axis]) + range_m < limit_m;
      }
      if (!inside) continue;
      CellWalk walk(start, direction, cell_size_m_);
      for (double begin_m = 0; begin_m < range_m; walk.advance()) {
        const double end_m = walk.end_m();
        const std::int32_t found = cells.find(walk.key());
        if (found >= 0 && crosses(i, surfels_[static_cast<std::size_t>(found)], begin_m, end_m)) {
          crossed[i] = found;
          break;
        }
        begin_m = end_m;
      }
    }
  });
}

}  // namespace radarsdf
