// Conversion of the returns of scans to rays in the local frame.
#pragma once

#include <cstdint>

namespace radarsdf {

struct PlacedScans {
  const double* points;       ///< (count, 3), sensor frame, m
  const std::int32_t* scans;  ///< (count), scan of each return
  std::int64_t count;
  const double* rotations;     ///< (scans, 3, 3), from the sensor to the world
  const double* positions;     ///< (scans, 3), of the sensor, local frame, m
  const double* seen_from;     ///< (scans, 3), origin of the rays, local frame, m
  const double* max_ranges_m;  ///< (scans)
};

// kept: (count), whether a return is within the range limits and not at the sensor. Returns their number, and writes
// as many rows of points and unit directions (count, 3) and ranges (count).
std::int64_t scan_rays(const PlacedScans& scans, double min_range_m, bool* kept, float* points, float* directions,
                       float* ranges_m, int num_threads);

// keys: (count), pseudo-random, for samples that do not depend on the order of rays, and of a part of a map only in
// their last bits. directions: (count, 3), ranges_m: (count), intensities: (count) or null.
void hash_rays(const float* directions, const float* ranges_m, const float* intensities, std::int64_t count,
               std::uint64_t* keys, int num_threads);

}  // namespace radarsdf
