// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Conversion of the returns of a scan to rays in the local frame.
#pragma once

#include <cstdint>

namespace radarsdf {

struct PlacedScan {
  const double* points;  ///< (count, 3), sensor frame, m
  std::int64_t count;
  const double* rotation;   ///< (3, 3), from the sensor to the world
  const double* position;   ///< of the sensor, local frame, m
  const double* seen_from;  ///< origin of the rays, local frame, m
};

// kept: (count,), whether a return is within the range limits and not at the sensor. Returns their number, and writes
// as many rows of points and unit directions (·, 3) and ranges (·).
std::int64_t scan_rays(const PlacedScan& scan, double min_range_m, double max_range_m, bool* kept, float* points,
                       float* directions, float* ranges_m);

}  // namespace radarsdf
