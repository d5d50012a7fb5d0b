#include "field/ray_samples.hpp"

#include <algorithm>

#include "field/field_loss.hpp"
#include "util/prefetch.hpp"
#include "util/random_bytes.hpp"

namespace radarsdf {

void draw_samples(const TakenRays& rays, const SampleLayout& layout, std::uint64_t seed, float* points, float* sdf_m,
                  float* of_ray) {
  constexpr std::int64_t kAhead = 16;  // prefetch distance: scattered rows are cache misses
  const auto row = [&](std::int64_t sample) { return rays.rows + rays.places[layout.ray[sample]] * rays.columns; };
  for (std::int64_t i = 0; i < layout.count; ++i) {
    prefetch(row(std::min(i + kAhead, layout.count - 1)));
    const float* ray = row(i);
    const RaySegment& segment = layout.segments[layout.kind[i]];
    const std::uint64_t word = random_word(seed, static_cast<std::uint64_t>(layout.number[i]));
    const float share = static_cast<float>(word >> 40) * 0x1p-24F;  // uniform in [0, 1)
    const float range_m = ray[kRayRange];
    const float start_m = segment.start + segment.start_of_range * range_m;
    sdf_m[i] = start_m + (segment.length + segment.length_of_range * range_m) * share;
    for (std::int64_t axis = 0; axis < 3; ++axis) {
      points[3 * i + axis] = ray[kRayPoint + axis] - sdf_m[i] * ray[kRayDirection + axis];
    }
    std::copy_n(ray, rays.columns, of_ray + i * rays.columns);
  }
}

}  // namespace radarsdf
