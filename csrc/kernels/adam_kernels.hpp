// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Adam (Kingma and Ba, ICLR 2015) on some rows of the feature matrix, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

#include "lattice/cell.hpp"

namespace radarsdf {

// What Adam remembers of a row besides its moments.
struct RowMark {
  std::int32_t last_step;  // in which it last moved; 0: never
  std::int32_t place;      // 1 + that of its sum among the sums of the step at hand; 0: the step has not touched it
};

// One step. It visits only the rows that the batch touches, so its cost does not grow with the map. The moments of a
// row fade for the steps that it missed, as with gradients of zero. Adam would also have moved the row in these steps,
// by what was left of its mean gradient: that movement is left out.
template <typename T>
struct AdamStep {
  T* features;        // (rows, 8)
  T* moments;         // (rows, 2, 8): mean and mean square of a row's gradients
  RowMark* marks;     // (rows)
  const T* decays;    // (step + 1, 2): both betas to the power of the steps since
  std::int32_t step;  // from 1 on
  T rate;             // learning rate / (1 - beta1^step)
  T square_scale;     // 1 / (1 - beta2^step)
  T epsilon;
};

template <typename T>
struct AdamKernel {
  // Moves rows[i], for i in [0, count), against gradients[i] (count, 8), which becomes zero, as does the row's place.
  void (*move)(const AdamStep<T>&, const std::int32_t* rows, T* gradients, std::int64_t count);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  template <typename T>              \
  AdamKernel<T> adam_kernel();       \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
