// Noise of a return's position along the beam, in azimuth and in elevation.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "util/vec3.hpp"

namespace radarsdf {

// Variances of a return's position: along the beam, m^2, in azimuth and in elevation, rad^2.
struct ReturnVariances {
  double range_m2, azimuth_rad2, elevation_rad2;
};

// From the array of `SensorNoise.variances` in Python.
using VarianceNumbers = std::array<double, 3>;

template <typename Numbers>
ReturnVariances variances_of(const Numbers& numbers) {
  return {numbers[0], numbers[1], numbers[2]};
}

// Variance of a return's position along `normal`, at this direction and range from a sensor with z axis `up`.
inline double variance_along(const Vec3& normal, const Vec3& direction, double range_m, const Vec3& up,
                             const ReturnVariances& noise) {
  constexpr double kMinSine = 1e-6;  // of the angle between a ray and the sensor's z axis, against division by 0
  const Vec3 horizontal = cross(up, direction);
  const Vec3 azimuth = horizontal / std::max(norm(horizontal), kMinSine);  // directions of increase
  const Vec3 elevation = cross(direction, azimuth);
  const auto square = [](double x) { return x * x; };
  return square(dot(direction, normal)) * noise.range_m2 +
         square(range_m) * (square(dot(azimuth, normal)) * noise.azimuth_rad2 +
                            square(dot(elevation, normal)) * noise.elevation_rad2);
}

}  // namespace radarsdf
