#include "returns/onto_planes.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "util/large_array.hpp"
#include "util/parallel.hpp"
#include "util/prefetch.hpp"

namespace radarsdf {
namespace {

constexpr double kMinRangeM = 1e-6;  // lower bound of a divisor
constexpr std::int64_t kAhead = 16;  // returns: the planes of consecutive ones are rarely in the cache

// All that a return needs, in one cache line.
struct alignas(64) Plane {
  double centre[3], normal[3];
  double roughness_m2;  // at first the sum of the noise variances of its returns
  std::int32_t count;
};

}  // namespace

void move_onto_planes(const NoisyRays& rays, const Planes& planes, const ReturnVariances& noise, const MovedRays& moved,
                      int num_threads) {
  LargeVector<Plane> own(static_cast<std::size_t>(planes.count));
  for (std::size_t p = 0; p < own.size(); ++p) {
    std::copy_n(planes.centres + 3 * p, 3, own[p].centre);
    std::copy_n(planes.normals + 3 * p, 3, own[p].normal);
  }
  // Variance of a return's position along the plane's normal.
  const auto variance_m2 = [&](std::int64_t i, const Plane& plane) {
    return variance_along(plane.normal, rays.directions + 3 * i, rays.ranges_m[i],
                          rays.up_of_scan + 3 * std::int64_t{rays.scans[i]}, noise);
  };
  const auto plane_of = [&](std::int64_t i) {
    prefetch(own.data() + std::max(rays.planes[std::min(i + kAhead, rays.count - 1)], 0));
    return rays.planes[i] < 0 ? nullptr : own.data() + rays.planes[i];
  };

  // Every thread reads all returns in order and adds those of its own planes.
  const std::int64_t threads = rays.count > (1 << 14) ? resolve_num_threads(num_threads) : 1;
  parallel_tasks(threads, num_threads, [&](std::int64_t task) {
    for (std::int64_t i = 0; i < rays.count; ++i) {
      Plane* plane = plane_of(i);
      if (plane == nullptr || (threads > 1 && (rays.planes[i] >> 6) % threads != task)) continue;
      plane->roughness_m2 += variance_m2(i, *plane);
      ++plane->count;
    }
  });
  for (std::size_t p = 0; p < own.size(); ++p)
    own[p].roughness_m2 = std::max(planes.variances_m2[p] - own[p].roughness_m2 / std::max(own[p].count, 1), 0.0);

  constexpr std::int64_t kRays = 1 << 14;  // per task
  std::vector<std::int64_t> firsts(static_cast<std::size_t>((rays.count + kRays - 1) / kRays));
  std::int64_t total = 0;
  for (std::size_t task = 0; task < firsts.size(); ++task) {
    const std::int64_t begin = static_cast<std::int64_t>(task) * kRays, end = std::min(rays.count, begin + kRays);
    firsts[task] = total;
    total += rays.kept == nullptr ? end - begin : std::count(rays.kept + begin, rays.kept + end, true);
  }
  parallel_tasks(static_cast<std::int64_t>(firsts.size()), num_threads, [&](std::int64_t task) {
    std::int64_t to = firsts[static_cast<std::size_t>(task)];
    for (std::int64_t i = task * kRays; i < std::min(rays.count, (task + 1) * kRays); ++i) {
      const Plane* plane = plane_of(i);
      if (rays.kept != nullptr && !rays.kept[i]) continue;
      const float *p = rays.points + 3 * i, *d = rays.directions + 3 * i;
      float *point = moved.points + 3 * to, *direction = moved.directions + 3 * to, *moved_m = moved.ranges_m + to;
      ++to;
      if (plane == nullptr) {
        std::copy(p, p + 3, point);
        std::copy(d, d + 3, direction);
        *moved_m = rays.ranges_m[i];
        continue;
      }
      const double *normal = plane->normal, *centre = plane->centre;
      const double variance = variance_m2(i, *plane), off[3] = {p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]};
      const double step_m = dot3(off, normal) * (variance / (variance + plane->roughness_m2));
      double ray[3];
      for (int axis = 0; axis < 3; ++axis) {
        point[axis] = static_cast<float>(p[axis] - step_m * normal[axis]);
        ray[axis] = double{d[axis]} * double{rays.ranges_m[i]} - step_m * normal[axis];
      }
      const double range_m = std::max(std::sqrt(dot3(ray, ray)), kMinRangeM);
      for (int axis = 0; axis < 3; ++axis) direction[axis] = static_cast<float>(ray[axis] / range_m);
      *moved_m = static_cast<float>(range_m);
    }
  });
}

}  // namespace radarsdf
