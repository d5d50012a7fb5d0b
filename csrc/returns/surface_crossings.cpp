#include "returns/surface_crossings.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "lattice/cell_walk.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr float kSlack = 0.25F;                 // cells: planes of neighbours do not exactly meet at their common face
constexpr double kBlockEdge = 1 << kBlockBits;  // cells
constexpr double kNever = std::numeric_limits<double>::infinity();

// Cells of a block, by axis, with coordinates from the first to the second index on.
using Slabs = std::array<std::array<std::array<std::uint64_t, 4>, 4>, 3>;
constexpr Slabs slabs_of_block() {
  Slabs slabs{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t first = 0; first < 4; ++first) {
      for (std::size_t last = first; last < 4; ++last) {
        for (std::size_t k = first; k <= last; ++k)
          slabs[axis][first][last] |= parts_where(static_cast<int>(axis), (k & 1) != 0, false, k > 1);
      }
    }
  }
  return slabs;
}
constexpr Slabs kSlabs = slabs_of_block();

// A ray in cells.
struct Line {
  double position[3], cells_per_m[3];  // of its end

  // Whether it enters the cell by `until_m`, in the block; distances at which it enters and leaves it.
  bool enters(const CellWalk& block, int part, double until_m, double& enters_m, double& leaves_m) const {
    enters_m = -kNever, leaves_m = kNever;
    for (int axis = 0; axis < 3; ++axis) {
      const int inside = (part >> axis & 1) | (part >> (axis + 2) & 2), ahead = cells_per_m[axis] >= 0 ? 1 : 0;
      const double m_per_cell = cells_per_m[axis] != 0 ? 1 / cells_per_m[axis] : kNever;
      const double behind = kBlockEdge * block.coordinate(axis) + inside + 1 - ahead - position[axis];
      const double in_m = behind * m_per_cell, out_m = (behind + 2 * ahead - 1) * m_per_cell;
      if (in_m > enters_m) enters_m = in_m;
      if (out_m < leaves_m) leaves_m = out_m;
    }
    return enters_m <= leaves_m && enters_m <= until_m;
  }

  // Cells of a block that may hold parts of the ray from begin_m to end_m, and others.
  std::uint64_t cells_near(const CellWalk& block, double begin_m, double end_m) const {
    constexpr double kRounding = 1e-6;
    constexpr int kLast = (1 << kBlockBits) - 1;
    std::uint64_t cells = ~std::uint64_t{0};
    for (int axis = 0; axis < 3; ++axis) {
      const double lower = position[axis] - kBlockEdge * block.coordinate(axis), slope = cells_per_m[axis];
      const double begin = lower + begin_m * slope, end = lower + end_m * slope;
      const auto cell = [](double place) {
        const int k = static_cast<int>(place);  // 0 from -1 on
        return static_cast<std::size_t>(k > kLast ? kLast : k < 0 ? 0 : k);
      };
      cells &= kSlabs[static_cast<std::size_t>(axis)][cell((begin < end ? begin : end) - kRounding)]
                     [cell((begin < end ? end : begin) + kRounding)];
    }
    return cells;
  }
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
  const double limit_m = (kAxisBias - (1 << kMaxLevels)) * cell_size_m_;  // NaN fails the comparison too
  // Upper bound of crossings along a ray, from its end, at any angle of incidence: see below.
  const double last_m = slack_m - margin_m - sigmas * noise.range_m;

  // Distance at which ray i enters a cell of the block where it crosses the plane of its surfel, and ends well behind
  // it; otherwise kNever.
  const auto crosses = [&](std::int64_t i, const Surfel& surfel, const Line& line, const CellWalk& block, int part) {
    const float *p = points + 3 * i, *d = directions + 3 * i, *n = surfel.normal, *c = surfel.centre;
    const float cosine = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
    const float depth_m = -(n[0] * (p[0] - c[0]) + n[1] * (p[1] - c[1]) + n[2] * (p[2] - c[2]));
    if (!(cosine > 0) || depth_m <= margin_m) return kNever;
    const double at_m = -depth_m / cosine;
    double enters_m, leaves_m;
    if (!line.enters(block, part, last_m, enters_m, leaves_m)) return kNever;
    if (at_m < std::max(enters_m, -double{ranges_m[i]}) - slack_m || at_m > leaves_m + slack_m) return kNever;
    float off_m2 = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const float off_m = p[axis] + static_cast<float>(at_m) * d[axis] - c[axis];
      off_m2 += off_m * off_m;
    }
    if (off_m2 > surfel.reach * surfel.reach) return kNever;
    const float along = noise.range_m * cosine, across = noise.angle_rad * ranges_m[i];
    const float variance =
        along * along + across * across * (1 - cosine * cosine) + surfel.thickness * surfel.thickness;
    return depth_m > margin_m + sigmas * std::sqrt(variance) ? enters_m : kNever;
  };

  constexpr std::int64_t kRays = 1 << 12;  // per task: few, so that a long traversal can be interrupted
  parallel_tasks((count + kRays - 1) / kRays, num_threads, [&](std::int64_t task) {
    NearbyRows rows(cells_);
    const std::int64_t end = std::min(count, (task + 1) * kRays);
    for (std::int64_t i = task * kRays; i < end; ++i) {
      crossed[i] = -1;
      const double range_m = ranges_m[i];
      bool inside = range_m > 0;
      for (int axis = 0; axis < 3; ++axis) inside = inside && std::abs(points[3 * i + axis]) + range_m < limit_m;
      if (!inside || -range_m > last_m) continue;
      // Most of the way is empty: only blocks with surfels near the ray, in regions with surfels, are searched.
      Line line;
      for (int axis = 0; axis < 3; ++axis) {
        line.position[axis] = points[3 * i + axis] / cell_size_m_;
        line.cells_per_m[axis] = directions[3 * i + axis] / cell_size_m_;
      }
      double begin_m = -range_m;
      const auto walk = [&](int bits) {
        return CellWalk(points + 3 * i, directions + 3 * i, begin_m, last_m, (1 << bits) * cell_size_m_,
                        kAxisBias >> bits);
      };
      CellWalk block = walk(kBlockBits);
      std::uint64_t last_region = kEmptyKey;
      while (block.inside() && crossed[i] < 0) {
        if (const std::uint64_t key = CellBlocks::block_key(block.key()); key != last_region) {
          last_region = key;
          if (cells_.region(key) == nullptr) {
            CellWalk region = walk(kRegionBits);
            for (; region.inside() && cells_.region(region.key()) == nullptr; region.next())
              begin_m = region.leaves_m();
            if (!region.inside()) break;
            if (begin_m > block.leaves_m()) {
              block = walk(kBlockBits);
              continue;
            }
          }
        }
        const double leaves_m = block.leaves_m();
        const Occupancy& cells = rows.block(block.key());
        std::uint64_t near = cells.mask;
        if (near != 0) near &= line.cells_near(block, begin_m, std::min(leaves_m, last_m));
        double first_m = kNever;
        for (; near != 0; near &= near - 1) {
          const int part = lowest_bit(near);
          const std::int32_t row = cells.row(static_cast<std::uint64_t>(part));
          const double enters_m = crosses(i, surfels_[static_cast<std::size_t>(row)], line, block, part);
          if (enters_m >= first_m) continue;
          first_m = enters_m;
          crossed[i] = row;
        }
        begin_m = std::max(begin_m, leaves_m);
        block.next();
      }
    }
  });
}

}  // namespace radarsdf
