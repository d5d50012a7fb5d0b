// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/onto_planes.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr double kMinRangeM = 1e-6;  // lower bound of a divisor

}  // namespace

void move_onto_planes(const NoisyRays& rays, const Planes& planes, const ReturnVariances& noise, const MovedRays& moved,
                      int num_threads) {
  // Variance of a return's position along the plane's normal.
  const auto variance_m2 = [&](std::int64_t i, const double* normal) {
    return variance_along(normal, rays.directions + 3 * i, rays.ranges_m[i],
                          rays.up_of_scan + 3 * std::int64_t{rays.scans[i]}, noise);
  };

  // Every thread reads all returns in order and adds those of its own planes.
  std::vector<double> roughness_m2(static_cast<std::size_t>(planes.count));
  std::vector<std::int32_t> counts(static_cast<std::size_t>(planes.count));
  const std::int64_t threads = rays.count > (1 << 14) ? resolve_num_threads(num_threads) : 1;
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    for (std::int64_t i = 0; i < rays.count; ++i) {
      const std::int32_t plane = rays.planes[i];
      if (plane < 0 || (plane >> 6) % threads != task) continue;
      roughness_m2[static_cast<std::size_t>(plane)] += variance_m2(i, planes.normals + 3 * std::int64_t{plane});
      ++counts[static_cast<std::size_t>(plane)];
    }
  });
  for (std::size_t p = 0; p < roughness_m2.size(); ++p) {
    roughness_m2[p] = std::max(planes.variances_m2[p] - roughness_m2[p] / std::max(counts[p], 1), 0.0);
  }

  parallel_blocks(rays.count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const float *p = rays.points + 3 * i, *d = rays.directions + 3 * i;
      float *point = moved.points + 3 * i, *direction = moved.directions + 3 * i;
      const std::int32_t plane = rays.planes[i];
      if (plane < 0) {
        std::copy(p, p + 3, point);
        std::copy(d, d + 3, direction);
        moved.ranges_m[i] = rays.ranges_m[i];
        continue;
      }
      const double *normal = planes.normals + 3 * std::int64_t{plane},
                   *centre = planes.centres + 3 * std::int64_t{plane};
      const double variance = variance_m2(i, normal), off[3] = {p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]};
      const double step_m = dot3(off, normal) * (variance / (variance + roughness_m2[static_cast<std::size_t>(plane)]));
      double ray[3];
      for (int axis = 0; axis < 3; ++axis) {
        point[axis] = static_cast<float>(p[axis] - step_m * normal[axis]);
        ray[axis] = double{d[axis]} * double{rays.ranges_m[i]} - step_m * normal[axis];
      }
      const double range_m = std::max(std::sqrt(dot3(ray, ray)), kMinRangeM);
      for (int axis = 0; axis < 3; ++axis) direction[axis] = static_cast<float>(ray[axis] / range_m);
      moved.ranges_m[i] = static_cast<float>(range_m);
    }
  });
}

}  // namespace radarsdf
