// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/scan_rays.hpp"

#include <algorithm>
#include <cmath>

namespace radarsdf {
namespace {

constexpr double kLeast_m = 1e-6;  // lower bound of ranges, which are divisors

double length(double x, double y, double z) { return std::sqrt(x * x + y * y + z * z); }

}  // namespace

std::int64_t scan_rays(const PlacedScan& scan, double min_range_m, double max_range_m, bool* kept, float* points,
                       float* directions, float* ranges_m) {
  std::int64_t next = 0;
  for (std::int64_t i = 0; i < scan.count; ++i) {
    const double* p = scan.points + 3 * i;
    const double from_sensor_m = length(p[0], p[1], p[2]);
    kept[i] = from_sensor_m > 0 && from_sensor_m >= min_range_m && from_sensor_m <= max_range_m;
    if (!kept[i]) continue;
    double ray[3];
    for (int axis = 0; axis < 3; ++axis) {
      const double* row = scan.rotation + 3 * axis;
      const double local = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + scan.position[axis];
      points[3 * next + axis] = static_cast<float>(local);
      ray[axis] = local - scan.seen_from[axis];
    }
    const double range_m = std::max(length(ray[0], ray[1], ray[2]), kLeast_m);
    for (int axis = 0; axis < 3; ++axis) directions[3 * next + axis] = static_cast<float>(ray[axis] / range_m);
    ranges_m[next++] = static_cast<float>(range_m);
  }
  return next;
}

}  // namespace radarsdf
