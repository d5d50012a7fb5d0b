// Fourier features of positions, compiled once for each instruction set (see interpolation_kernels.hpp).
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kMaxFrequencies = 24;

// out (n, 6 * count), rows `stride` apart: sin, then cos, of 2^k * pi * x * inverse_half_width for k = first ..
// first + count - 1, the three axes of one frequency side by side.
template <typename T>
struct FourierKernel {
  void (*encode)(const T* points, T inverse_half_width, int first, int count, T* out, std::int64_t stride,
                 std::int64_t begin, std::int64_t end);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  template <typename T>              \
  FourierKernel<T> fourier_kernel(); \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
