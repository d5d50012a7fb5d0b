#include "returns/scan_rays.hpp"

#include <algorithm>
#include <cmath>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr double kLeast_m = 1e-6;  // lower bound of ranges, which are divisors

double length(double x, double y, double z) { return std::sqrt(x * x + y * y + z * z); }

}  // namespace

std::int64_t scan_rays(const PlacedScans& scans, double min_range_m, bool* kept, float* points, float* directions,
                       float* ranges_m, int num_threads) {
  parallel_blocks(scans.count, 1 << 13, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t scan = scans.scans[i];
      const double *p = scans.points + 3 * i, *position = scans.positions + 3 * scan;
      const double from_sensor_m = length(p[0], p[1], p[2]);
      kept[i] = from_sensor_m > 0 && from_sensor_m >= min_range_m && from_sensor_m <= scans.max_ranges_m[scan];
      if (!kept[i]) continue;
      double ray[3];
      for (int axis = 0; axis < 3; ++axis) {
        const double* row = scans.rotations + 9 * scan + 3 * axis;
        const double local = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + position[axis];
        points[3 * i + axis] = static_cast<float>(local);
        ray[axis] = local - scans.seen_from[3 * scan + axis];
      }
      const double range_m = std::max(length(ray[0], ray[1], ray[2]), kLeast_m);
      for (int axis = 0; axis < 3; ++axis) directions[3 * i + axis] = static_cast<float>(ray[axis] / range_m);
      ranges_m[i] = static_cast<float>(range_m);
    }
  });
  std::int64_t rows = 0;
  for (std::int64_t i = 0; i < scans.count; ++i) {
    if (!kept[i]) continue;
    std::copy_n(points + 3 * i, 3, points + 3 * rows);
    std::copy_n(directions + 3 * i, 3, directions + 3 * rows);
    ranges_m[rows++] = ranges_m[i];
  }
  return rows;
}

}  // namespace radarsdf
