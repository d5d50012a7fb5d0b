// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Random samples on rays with the labels of their signed distances: a batch of the training in one call.
#pragma once

#include <cstdint>

namespace radarsdf {

// A sample is drawn uniformly from a segment of its ray, which begins start + start_of_range · range in front of the
// return, m, and has the length length + length_of_range · range towards the sensor.
struct RaySegment {
  float start, start_of_range, length, length_of_range;
};

// Rays as rows (see field_loss.hpp), of which a batch takes those at `places`.
struct TakenRays {
  const float* rows;
  std::int64_t columns;
  const std::int64_t* places;
};

// Which of the taken rays each of `count` samples is on, the number that finds its random number, and its segment.
struct SampleLayout {
  const std::int32_t* ray;
  const std::int32_t* number;
  const std::uint8_t* kind;
  const RaySegment* segments;  // of each kind
  std::int64_t count;
};

// Writes points (count, 3), labels of their signed distances (count), m, and the rows of their rays (count, columns).
void draw_samples(const TakenRays& rays, const SampleLayout& layout, std::uint64_t seed, float* points, float* sdf_m,
                  float* of_ray);

}  // namespace radarsdf
