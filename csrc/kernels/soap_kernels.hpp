// Kernels of a SOAP step besides matrix products, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

namespace radarsdf {

template <typename T>
struct SoapKernels {
  // Updates running means and mean squares by a gradient with weight 1 - beta; writes mean / (root(square) + epsilon).
  void (*add)(const T* gradient, T beta, T epsilon, T* means, T* squares, T* ways, std::int64_t count);
  void (*scale)(T* numbers, T factor, std::int64_t count);
  // Orthonormalises a square matrix of `count` rows by Gram-Schmidt. Rows are `stride` apart, a multiple of 16, padded
  // with zeros. False if a row is linearly dependent or not finite.
  bool (*orthonormalise)(T* rows, std::int64_t count, std::int64_t stride);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  template <typename T>              \
  SoapKernels<T> soap_kernels();     \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
