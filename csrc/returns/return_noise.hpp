// Noise of a return's position along the beam, in azimuth and in elevation.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>

namespace radarsdf {

// Variances of a return's position: along the beam, m^2, in azimuth and in elevation, rad^2.
struct ReturnVariances {
  double range_m2, azimuth_rad2, elevation_rad2;
};

// From the array of `SensorNoise.variances` in Python.
using VarianceNumbers = std::array<double, 3>;

inline ReturnVariances variances_of(const VarianceNumbers& numbers) { return {numbers[0], numbers[1], numbers[2]}; }

template <typename A, typename B>
double dot3(const A* a, const B* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline void cross3(const double* a, const double* b, double* product) {
  product[0] = a[1] * b[2] - a[2] * b[1];
  product[1] = a[2] * b[0] - a[0] * b[2];
  product[2] = a[0] * b[1] - a[1] * b[0];
}

// Variance of a return's position along `normal`, at this direction and range from a sensor with z axis `up`.
inline double variance_along(const double* normal, const float* direction, double range_m, const double* up,
                             const ReturnVariances& noise) {
  constexpr double kMinSine = 1e-6;  // of the angle between a ray and the sensor's z axis, against division by 0
  const double along[3] = {direction[0], direction[1], direction[2]};
  double azimuth[3], elevation[3];  // directions of increase
  cross3(up, along, azimuth);
  const double sine = std::max(std::sqrt(dot3(azimuth, azimuth)), kMinSine);
  for (double& component : azimuth) component /= sine;
  cross3(along, azimuth, elevation);
  const auto square = [](double x) { return x * x; };
  return square(dot3(along, normal)) * noise.range_m2 +
         square(range_m) * (square(dot3(azimuth, normal)) * noise.azimuth_rad2 +
                            square(dot3(elevation, normal)) * noise.elevation_rad2);
}

}  // namespace radarsdf
