// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The returns of a scan as rays in the local frame.
#pragma once

#include <cstdint>

namespace radarsdf {

struct PlacedScan {
  const double* points;  ///< (count, 3), sensor frame, m
  std::int64_t count;
  const double* rotation;   ///< (3, 3), from the sensor to the world
  const double* position;   ///< of the sensor, local frame, m
  const double* seen_from;  ///< where the rays begin, local frame, m
};

// kept: (count,), whether a return is no farther from its sensor than the ranges allow, and not at the sensor itself.
// Returns how many are, and writes that many rows of points and unit directions (·, 3) and ranges (·).
std::int64_t scan_rays(const PlacedScan& scan, double min_range_m, double max_range_m, bool* kept, float* points,
                       float* directions, float* ranges_m);

}  // namespace radarsdf
