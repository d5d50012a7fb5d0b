// Shrinks noisy returns towards the planes of their neighbourhood (Wiener 1949).
#pragma once

#include <cstdint>

#include "returns/return_noise.hpp"

namespace radarsdf {

// Rays in the local frame, m.
struct NoisyRays {
  const float* points;         ///< (count, 3)
  const float* directions;     ///< (count, 3), unit, from the sensor
  const float* ranges_m;       ///< (count)
  const std::int32_t* scans;   ///< (count)
  const std::int32_t* planes;  ///< (count), the plane of each return; -1: none, not moved
  const bool* kept;            ///< (count), rays to write; nullptr: all
  std::int64_t count;
  const double* up_of_scan;     ///< (scans, 3), the z axis of the sensor
  const double* noise_of_scan;  ///< (scans, 3), variances along the beam, m^2, in azimuth and elevation, rad^2
};

struct Planes {
  const double* centres;       ///< (count, 3), local frame, m
  const double* normals;       ///< (count, 3), unit
  const double* variances_m2;  ///< (count), of the returns across each plane
  std::int64_t count;
};

// The kept rays, in their order.
struct MovedRays {
  float *points, *directions, *ranges_m;
};

// A return keeps the share tau^2 / (tau^2 + sigma^2) of its distance from its plane: sigma^2 is the variance of its
// noise across the plane, tau^2 that of all returns of the plane minus the mean of their sigma^2. Independent of the
// number of threads.
void move_onto_planes(const NoisyRays& rays, const Planes& planes, const MovedRays& moved, int num_threads);

}  // namespace radarsdf
