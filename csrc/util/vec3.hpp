// Vectors in space, in double precision.
#pragma once

#include <cmath>
#include <cstdint>

namespace radarsdf {

struct Vec3 {
  double values[3];

  double operator[](int axis) const { return values[axis]; }
  double& operator[](int axis) { return values[axis]; }
};

// A row of a matrix (N, 3).
template <typename T>
Vec3 vec3(const T* rows, std::int64_t row = 0) {
  const T* v = rows + 3 * row;
  return {static_cast<double>(v[0]), static_cast<double>(v[1]), static_cast<double>(v[2])};
}

inline Vec3 operator+(const Vec3& a, const Vec3& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vec3 operator*(double factor, const Vec3& v) { return {factor * v[0], factor * v[1], factor * v[2]}; }
inline Vec3 operator/(const Vec3& v, double divisor) { return {v[0] / divisor, v[1] / divisor, v[2] / divisor}; }

inline double dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double norm(const Vec3& v) { return std::sqrt(dot(v, v)); }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Writes a row of a matrix (N, 3).
template <typename T>
void store(const Vec3& v, T* row) {
  for (int axis = 0; axis < 3; ++axis) row[axis] = static_cast<T>(v[axis]);
}

}  // namespace radarsdf
