#include "returns/surface_crossings.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>

#include "lattice/cell_walk.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr float kSlack = 0.25F;                 // cells: planes of neighbours do not exactly meet at their common face
constexpr double kBlockEdge = 1 << kBlockBits;  // cells
// Consecutive ones, after which a ray steps by blocks again: no fewer than the cells of a block that a line crosses.
constexpr int kEmptyCells = 3 * (1 << kBlockBits) - 2;

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

// Cells of a block that may hold parts of a line from begin_m to end_m, and others.
std::uint64_t cells_near(const CellLine& line, const CellWalk& block, double begin_m, double end_m) {
  constexpr double kRounding = 1e-6;
  constexpr int kLast = (1 << kBlockBits) - 1;
  std::uint64_t cells = ~std::uint64_t{0};
  for (int axis = 0; axis < 3; ++axis) {
    const double lower = line.position[axis] - kBlockEdge * block.coordinate(axis), slope = line.cells_per_m[axis];
    const double begin = lower + begin_m * slope, end = lower + end_m * slope;
    const auto cell = [](double place) {
      const int k = static_cast<int>(place);  // 0 from -1 on
      return static_cast<std::size_t>(k > kLast ? kLast : k < 0 ? 0 : k);
    };
    cells &= kSlabs[axis][cell((begin < end ? begin : end) - kRounding)][cell((begin < end ? end : begin) + kRounding)];
  }
  return cells;
}

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

  // Whether ray i crosses the surfel's plane between begin_m and end_m from its end, and ends well behind it.
  const auto crosses = [&](std::int64_t i, const Surfel& surfel, double begin_m, double end_m) {
    const float *p = points + 3 * i, *d = directions + 3 * i, *n = surfel.normal, *c = surfel.centre;
    const float cosine = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
    const float depth_m = -(n[0] * (p[0] - c[0]) + n[1] * (p[1] - c[1]) + n[2] * (p[2] - c[2]));
    if (!(cosine > 0) || depth_m <= margin_m) return false;
    const double at_m = -depth_m / cosine;
    if (at_m < begin_m - slack_m || at_m > end_m + slack_m) return false;
    float off_m2 = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const float off_m = p[axis] + static_cast<float>(at_m) * d[axis] - c[axis];
      off_m2 += off_m * off_m;
    }
    if (off_m2 > surfel.reach * surfel.reach) return false;
    const float along = noise.range_m * cosine, across = noise.angle_rad * ranges_m[i];
    const float variance =
        along * along + across * across * (1 - cosine * cosine) + surfel.thickness * surfel.thickness;
    return depth_m > margin_m + sigmas * std::sqrt(variance);
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
      // Most of the way is empty: only where regions and blocks hold surfels nearby is the ray followed from cell to
      // cell.
      const CellLine line(points + 3 * i, directions + 3 * i, cell_size_m_);
      double begin_m = -range_m;
      const auto walk = [&](int bits) { return CellWalk(line, begin_m, last_m, 1 << bits, kAxisBias >> bits); };
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
        const std::uint64_t cells = rows.block(block.key()).mask;
        if (cells != 0 && (cells & cells_near(line, block, begin_m, std::min(leaves_m, last_m))) != 0) {
          int on_end = 0;
          for (CellWalk cell = walk(0); cell.inside(); cell.next()) {
            const double end_m = cell.leaves_m();
            const std::int32_t row = rows.row(cell.key());
            on_end = row < 0 ? on_end + 1 : 0;
            if (on_end > kEmptyCells) break;
            if (row >= 0 && crosses(i, surfels_[row], begin_m, end_m)) {
              crossed[i] = row;
              break;
            }
            begin_m = end_m;
          }
        }
        begin_m = std::max(begin_m, leaves_m);
        while (block.inside() && block.leaves_m() <= begin_m) block.next();
      }
    }
  });
}

}  // namespace radarsdf
