// Random samples on rays with labels of their signed distances: a training batch in one call.
#pragma once

#include <cstdint>

namespace radarsdf {

// Segment of a ray from which a sample is drawn uniformly: it begins start + start_of_range · range before the return,
// m, and extends by length + length_of_range · range towards the sensor.
struct RaySegment {
  float start, start_of_range, length, length_of_range;
};

// Rays as rows (see field_loss.hpp); a batch takes those at `places`.
struct TakenRays {
  const float* rows;
  std::int64_t columns;
  const std::int64_t* places;
};

// For each of `count` samples its ray among those taken, the index of its random number, and its segment.
struct SampleLayout {
  const std::int32_t* ray;
  const std::int32_t* number;
  const std::uint8_t* kind;
  const RaySegment* segments;  // by kind
  std::int64_t count;
};

// Writes points (count, 3), labels of their signed distances (count), m, and the rows of their rays (count, columns).
void draw_samples(const TakenRays& rays, const SampleLayout& layout, std::uint64_t seed, float* points, float* sdf_m,
                  float* of_ray);

}  // namespace radarsdf
