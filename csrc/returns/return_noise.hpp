// Noise of a return's position along the beam, in azimuth and in elevation.
#pragma once

#include <algorithm>
#include <array>
#include <vector>

#include "util/vec3.hpp"

namespace radarsdf {

// Variances of a return's position: along the beam, m^2, in azimuth and in elevation, rad^2.
struct ReturnVariances {
  double range_m2, azimuth_rad2, elevation_rad2;
};

using VarianceNumbers = std::array<double, 3>;  // `SensorNoise.variances` in Python

template <typename Numbers>
ReturnVariances variances_of(const Numbers& numbers) {
  return {numbers[0], numbers[1], numbers[2]};
}

constexpr double kLeastM2 = 1e-10;  // lower bound of squares that are divisors

// A return relative to a sensor with z axis `up`.
struct Beam {
  Beam(const Vec3& from_sensor, const Vec3& up)
      : point(from_sensor),
        across(cross(up, point)),
        range_m2(std::max(dot(point, point), kLeastM2)),
        across_m2(std::max(dot(across, across), kLeastM2)) {}

  // Variance of its position along a unit vector, whose squared components by the three directions add up to 1.
  double variance_along(const Vec3& normal, const ReturnVariances& noise) const {
    const double range = dot(point, normal), azimuth = dot(across, normal);
    const double of_range = range * range / range_m2, of_azimuth = azimuth * azimuth / across_m2;
    const double of_elevation = std::max(1 - of_range - of_azimuth, 0.0);
    return of_range * noise.range_m2 +
           range_m2 * (of_azimuth * noise.azimuth_rad2 + of_elevation * noise.elevation_rad2);
  }

  Vec3 point, across;  // `across`: towards increasing azimuth, as long as the distance from the z axis
  double range_m2, across_m2;
};

// Square root of the Geman-McClure weight of a residual: 1/2 at two standard deviations.
inline double robust_share(double value, double variance) { return 1 / (1 + value * value / (4 * variance)); }

// Median of squared normalised residuals, which it reorders, relative to that of Gaussian noise; at least 1.
inline double scale_of(std::vector<double>& squares) {
  constexpr double kMedianOfSquare = 0.4549;
  const auto middle = squares.begin() + static_cast<std::ptrdiff_t>(squares.size() / 2);
  std::nth_element(squares.begin(), middle, squares.end());
  return std::max(1.0, *middle / kMedianOfSquare);
}

}  // namespace radarsdf
