#include "kernels/fourier_kernels.hpp"

#include <math.h>  // not <cmath>, whose inline overloads could leave this copy's instruction set
#include <string.h>

#ifndef RADARSDF_ISA
#error "RADARSDF_ISA names the instruction set that this copy is compiled for"
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

inline float round_to_even(float v) { return rintf(v); }
inline double round_to_even(double v) { return rint(v); }

// sin and cos of pi * t. Range reduction to |e| <= 1/4 precedes the multiplication by pi, so large frequencies lose no
// accuracy beyond that of t itself (2^15 pi in single precision has an error of 1e-2 radians). Taylor series: the first
// omitted term at pi/4 is below 2e-9 (float) and 1e-19 (double).
template <typename T>
inline void sincos_pi(T t, T* sine, T* cosine) {
  const T quarter = round_to_even(2 * t);
  const T e = static_cast<T>(3.14159265358979323846) * (t - quarter / 2);
  const T e2 = e * e;
  T s, c;
  if (sizeof(T) == 4) {
    s = e * (1 + e2 * (T(-1. / 6) + e2 * (T(1. / 120) + e2 * (T(-1. / 5040) + e2 * T(1. / 362880)))));
    c = 1 + e2 * (T(-1. / 2) + e2 * (T(1. / 24) + e2 * (T(-1. / 720) + e2 * T(1. / 40320))));
  } else {
    s = c = 0;
    for (int i = 9; i-- > 0;) {
      s = 1 - e2 * s / static_cast<T>((2 * i + 2) * (2 * i + 3));
      c = 1 - e2 * c / static_cast<T>((2 * i + 1) * (2 * i + 2));
    }
    s *= e;
  }
  const T quadrant = quarter - 4 * round_to_even(quarter / 4);  // -2 .. 2; -2 and 2 are equivalent
  const bool swapped = quadrant == 1 || quadrant == -1;
  const T unsigned_sine = swapped ? c : s, unsigned_cosine = swapped ? s : c;
  *sine = quadrant == 0 || quadrant == 1 ? unsigned_sine : -unsigned_sine;
  *cosine = quadrant == 0 || quadrant == -1 ? unsigned_cosine : -unsigned_cosine;
}

template <typename T>
void encode(const T* points, T inverse_half_width, int first, int count, T* out, std::int64_t stride,
            std::int64_t begin, std::int64_t end) {
  constexpr int kLanes = 8;            // full vectors: a shorter loop would have a scalar tail
  T angles[3 * kMaxFrequencies] = {};  // in units of pi; scaling by a power of two is exact
  T sines[3 * kMaxFrequencies], cosines[3 * kMaxFrequencies];
  for (std::int64_t n = begin; n < end; ++n) {
    T scale = static_cast<T>(1 << first);
    for (int k = 0; k < count; ++k, scale *= 2) {
      for (int axis = 0; axis < 3; ++axis) angles[3 * k + axis] = points[3 * n + axis] * inverse_half_width * scale;
    }
    for (int i = 0; i < 3 * count; i += kLanes) {
      for (int lane = i; lane < i + kLanes; ++lane) sincos_pi(angles[lane], &sines[lane], &cosines[lane]);
    }
    T* own = out + n * stride;
    memcpy(own, sines, sizeof(T) * static_cast<size_t>(3 * count));
    memcpy(own + 3 * count, cosines, sizeof(T) * static_cast<size_t>(3 * count));
  }
}

}  // namespace

template <typename T>
FourierKernel<T> fourier_kernel() {
  return {encode<T>};
}

template FourierKernel<float> fourier_kernel();
template FourierKernel<double> fourier_kernel();

}  // namespace radarsdf::RADARSDF_ISA
