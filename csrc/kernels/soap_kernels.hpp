// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What a step of SOAP is made of besides products of matrices, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

namespace radarsdf {

template <typename T>
struct SoapKernels {
  // Adds a gradient to running means and mean squares of weight 1 - beta, and writes mean / (root(square) + epsilon).
  void (*add)(const T* gradient, T beta, T epsilon, T* means, T* squares, T* ways, std::int64_t count);
  void (*scale)(T* numbers, T factor, std::int64_t count);
  // Makes `count` rows of as many numbers orthonormal, one after the other. They are `stride` apart, a multiple of 16,
  // with zeros between them. False if one has no direction of its own that is finite.
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
