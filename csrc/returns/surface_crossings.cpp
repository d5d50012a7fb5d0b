// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/surface_crossings.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "lattice/morton.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr float kSlack = 0.25F;  // of a cell: planes of neighbours do not quite meet at their common face

// A ray in the lattice's units. Where it meets a face of the lattice depends on that face alone and not on the cells
// before it, so a walk that begins midway goes through the same cells, at the same distances, as one from the sensor.
struct LatticeRay {
  LatticeRay(const double* start_m, const double* direction, double cell_size_m) {
    for (int axis = 0; axis < 3; ++axis) {
      start[axis] = start_m[axis] / cell_size_m;
      first_cell[axis] = static_cast<std::int32_t>(std::floor(start[axis])) + kAxisBias;
      forward[axis] = direction[axis] >= 0 ? 1 : 0;
      cells_per_m[axis] = direction[axis] / cell_size_m;
      m_per_cell[axis] = cells_per_m[axis] != 0 ? 1 / cells_per_m[axis] : std::numeric_limits<double>::infinity();
    }
  }

  double face_m(int axis, std::int32_t face) const {  // distance from the sensor; of a face at or ahead of it
    return ((face - kAxisBias) - start[axis]) * m_per_cell[axis];
  }

  double start[3];                       // of the sensor, in cells
  std::int32_t first_cell[3];            // the cell that it is in, biased as for keys
  std::int32_t forward[3];               // 1 where the coordinate grows along the ray, else 0
  double cells_per_m[3], m_per_cell[3];  // negative where the coordinate falls
};

// Walks the cells along a ray in order (Amanatides and Woo 1987), or its cubes of 2^shift cells an edge.
class CellWalk {
 public:
  // From the sensor's cube on.
  CellWalk(const LatticeRay& ray, int shift) : CellWalk(ray, shift, ray.first_cell, 0) {}

  // From where another walk, of larger cubes, has just got to.
  CellWalk(const CellWalk& other, int shift) : CellWalk(*other.ray_, shift, other.entered_cell().at, other.begin_m_) {
    entered_axis_ = other.entered_axis_;
  }

  std::uint64_t key() const { return key_[0] | key_[1] | key_[2]; }
  double begin_m() const { return begin_m_; }               ///< where the ray enters the cube
  double end_m() const { return next_m_[nearest_axis()]; }  ///< where it leaves it

  void advance() {
    entered_axis_ = nearest_axis();
    begin_m_ = next_m_[entered_axis_];
    cube_[entered_axis_] += 2 * ray_->forward[entered_axis_] - 1;
    look_ahead(entered_axis_);
  }

 private:
  struct LatticeCell {
    std::int32_t at[3];
  };

  CellWalk(const LatticeRay& ray, int shift, const std::int32_t* cell, double begin_m)
      : ray_(&ray), shift_(shift), begin_m_(begin_m) {
    for (int axis = 0; axis < 3; ++axis) {
      cube_[axis] = cell[axis] >> shift;
      look_ahead(axis);
    }
  }

  void look_ahead(int axis) {
    next_m_[axis] = ray_->face_m(axis, (cube_[axis] + ray_->forward[axis]) * (1 << shift_));
    key_[axis] = spread_bits(static_cast<std::uint32_t>(cube_[axis])) << axis;
  }

  int nearest_axis() const {
    const int axis = next_m_[1] < next_m_[0] ? 1 : 0;
    return next_m_[2] < next_m_[axis] ? 2 : axis;
  }

  // The first lattice cell of the cube that the ray goes through. The rounded position may be one cell off; then the
  // distances of the faces decide. Faces at the same distance count in the order of nearest_axis.
  LatticeCell entered_cell() const {
    LatticeCell cell;
    for (int axis = 0; axis < 3; ++axis) {
      const std::int32_t low = cube_[axis] * (1 << shift_), high = low + (1 << shift_) - 1;
      const std::int32_t forward = ray_->forward[axis], step = 2 * forward - 1, sensor = ray_->first_cell[axis];
      const std::int32_t first = forward != 0 ? std::max(low, sensor) : std::min(high, sensor);
      const std::int32_t last = forward != 0 ? high : low;
      const auto met = [&](std::int32_t face) {
        const double face_m = ray_->face_m(axis, face);
        return face_m < begin_m_ || (face_m == begin_m_ && axis < entered_axis_);
      };
      // Biased coordinates are positive, so the cast rounds down.
      const double position = ray_->start[axis] + begin_m_ * ray_->cells_per_m[axis] + kAxisBias;
      std::int32_t& at = cell.at[axis];
      at = static_cast<std::int32_t>(std::clamp<double>(position, low, high));
      at = forward != 0 ? std::max(at, first) : std::min(at, first);
      while (at != last && met(at + forward)) at += step;
      while (at != first && !met(at + 1 - forward)) at -= step;
    }
    return cell;
  }

  const LatticeRay* ray_;
  int shift_, entered_axis_ = -1;
  std::int32_t cube_[3] = {};
  std::uint64_t key_[3] = {};
  double begin_m_, next_m_[3] = {};
};

}  // namespace

SurfelMap::SurfelMap(const std::uint64_t* keys, const Surfel* surfels, std::int64_t count, double cell_size_m)
    : cell_size_m_(cell_size_m), cells_(keys, count), surfels_(surfels, surfels + count) {
  if (!(cell_size_m > 0) || !std::isfinite(cell_size_m)) {
    throw std::invalid_argument("cell_size_m must be positive and finite");
  }
}

void SurfelMap::first_crossings(const float* points, const float* directions, const float* ranges_m, std::int64_t count,
                                BeamNoise noise, float margin_m, float sigmas, std::int32_t* crossed,
                                int num_threads) const {
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

  // What the ray i crosses in one block, in one region; the ray is where the walk has just got to.
  const auto crossed_in_block = [&](std::int64_t i, const CellWalk& blocks, const Occupancy& block) {
    for (CellWalk walk(blocks, 0); walk.begin_m() < ranges_m[i]; walk.advance()) {
      if (CellBlocks::block_key(walk.key()) != blocks.key()) break;
      const std::int32_t found = block.row(walk.key());
      if (found >= 0 && crosses(i, surfels_[static_cast<std::size_t>(found)], walk.begin_m(), walk.end_m())) {
        return found;
      }
    }
    return -1;
  };
  const auto crossed_in_region = [&](std::int64_t i, const CellWalk& regions, const Occupancy& region) {
    for (CellWalk blocks(regions, kBlockBits); blocks.begin_m() < ranges_m[i]; blocks.advance()) {
      if (blocks.key() >> (3 * (kRegionBits - kBlockBits)) != regions.key()) break;
      const Occupancy* block = cells_.block(region, blocks.key());
      const std::int32_t found = block != nullptr ? crossed_in_block(i, blocks, *block) : -1;
      if (found >= 0) return found;
    }
    return -1;
  };

  constexpr std::int64_t kRays = 1 << 12;  // a task: few enough for a long walk to be interrupted
  parallel_tasks((count + kRays - 1) / kRays, num_threads, [&](std::int64_t task) {
    const std::int64_t end = std::min(count, (task + 1) * kRays);
    for (std::int64_t i = task * kRays; i < end; ++i) {
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
      const LatticeRay ray(start, direction, cell_size_m_);
      for (CellWalk regions(ray, kRegionBits); crossed[i] < 0 && regions.begin_m() < range_m; regions.advance()) {
        const Occupancy* region = cells_.region(regions.key());
        if (region != nullptr) crossed[i] = crossed_in_region(i, regions, *region);
      }
    }
  });
}

}  // namespace radarsdf
