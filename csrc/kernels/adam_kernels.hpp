// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Sparse Adam (Kingma and Ba, ICLR 2015) on rows of the feature matrix, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

#include "lattice/cell.hpp"

namespace radarsdf {

// State of a row besides its moments.
struct RowMark {
  std::int32_t last_step;  // step of its last update; 0: never
  std::int32_t place;      // 1 + index of its sum in the current step; 0: not touched
};

// One step. It visits only the rows that the batch touches, so its cost is independent of the size of the map. The
// moments of a row decay over the steps that it missed, as with gradients of zero. Adam would also have moved the row
// in these steps, along its decaying mean gradient: these updates are omitted.
template <typename T>
struct AdamStep {
  T* features;        // (rows, 8)
  T* moments;         // (rows, 2, 8): mean and mean square of a row's gradients
  RowMark* marks;     // (rows)
  const T* decays;    // (step + 1, 2): powers of both betas by steps since the last update
  std::int32_t step;  // from 1 on
  T rate;             // learning rate / (1 - beta1^step)
  T square_scale;     // 1 / (1 - beta2^step)
  T epsilon;
};

template <typename T>
struct AdamKernel {
  // Updates rows[i], for i in [0, count), by gradients[i] (count, 8); resets gradients and places to zero.
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
