#include "returns/onto_planes.hpp"

#include <algorithm>
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
  Vec3 centre, normal;
  double roughness_m2;  // at first the sum of the noise variances of its returns
  std::int32_t count;
};

}  // namespace

void move_onto_planes(const NoisyRays& rays, const Planes& planes, const MovedRays& moved, int num_threads) {
  LargeVector<Plane> own(planes.count);
  for (std::size_t p = 0; p < own.size(); ++p) {
    own[p].centre = vec3(planes.centres, p);
    own[p].normal = vec3(planes.normals, p);
  }
  // Variance of a return's position along the plane's normal.
  const auto variance_m2 = [&](std::int64_t i, const Plane& plane) {
    const Beam beam(rays.ranges_m[i] * vec3(rays.directions, i), vec3(rays.up_of_scan, rays.scans[i]));
    return beam.variance_along(plane.normal, variances_of(rays.noise_of_scan + 3 * std::int64_t{rays.scans[i]}));
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
  std::vector<std::int64_t> firsts(num_chunks(rays.count, kRays));
  std::int64_t total = 0;
  for (std::size_t task = 0; task < firsts.size(); ++task) {
    const std::int64_t begin = static_cast<std::int64_t>(task) * kRays, end = std::min(rays.count, begin + kRays);
    firsts[task] = total;
    total += rays.kept == nullptr ? end - begin : std::count(rays.kept + begin, rays.kept + end, true);
  }
  parallel_chunks(rays.count, kRays, num_threads, [&](std::int64_t task, std::int64_t begin, std::int64_t end) {
    std::int64_t to = firsts[task];
    for (std::int64_t i = begin; i < end; ++i) {
      const Plane* plane = plane_of(i);
      if (rays.kept != nullptr && !rays.kept[i]) continue;
      Vec3 point = vec3(rays.points, i), direction = vec3(rays.directions, i);
      double range_m = rays.ranges_m[i];
      if (plane != nullptr) {
        const double variance = variance_m2(i, *plane), off_m = dot(point - plane->centre, plane->normal);
        const Vec3 step_m = off_m * (variance / (variance + plane->roughness_m2)) * plane->normal;
        point = point - step_m;
        const Vec3 ray = range_m * direction - step_m;
        range_m = std::max(norm(ray), kMinRangeM);
        direction = ray / range_m;
      }
      store(point, moved.points + 3 * to);
      store(direction, moved.directions + 3 * to);
      moved.ranges_m[to++] = static_cast<float>(range_m);
    }
  });
}

}  // namespace radarsdf
