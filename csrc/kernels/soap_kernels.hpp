// Kernels of a SOAP step besides matrix products, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

namespace radarsdf {

struct SoapKernels {
  // Updates running means and mean squares by a gradient with weight 1 - beta; writes mean / (root(square) + epsilon).
  void (*add)(const float* gradient, float beta, float epsilon, float* means, float* squares, float* ways,
              std::int64_t count);
  void (*scale)(float* numbers, float factor, std::int64_t count);
  // Orthonormalises a square matrix of `count` rows by Gram-Schmidt. Rows are `stride` apart, a multiple of 16, padded
  // with zeros. False if a row is linearly dependent or not finite.
  bool (*orthonormalise)(float* rows, std::int64_t count, std::int64_t stride);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  SoapKernels soap_kernels();        \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
