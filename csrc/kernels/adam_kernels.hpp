// Sparse Adam (Kingma and Ba, ICLR 2015) on rows of the feature matrix, compiled once for each instruction set (see
// interpolation_kernels.hpp).
#pragma once

#include <cstdint>

#include "lattice/cell.hpp"

namespace radarsdf {

// State of a row: half a cache line, since a step on a large map takes as long as its cache misses. The features of a
// row share one mean square, and their mean gradients are rounded to bfloat16.
struct RowState {
  std::uint16_t mean[kFeatureDim];
  float square;
  std::int32_t last_step;  // step of its last update; 0: never
  std::int32_t place;      // 1 + index of its sum in the current step; 0: not touched
  std::int32_t unused;
};
static_assert(sizeof(RowState) == 32, "two states fill a cache line");

// One step. It visits only the rows that the batch touches, so its cost is independent of the size of the map. The
// moments of a row decay over the steps that it missed, as with gradients of zero. Adam would also have moved the row
// in these steps, along its decaying mean gradient: these updates are omitted.
struct AdamStep {
  float* features;      // (rows, 8)
  RowState* states;     // (rows)
  const float* decays;  // (step + 1, 2): powers of both betas by steps since the last update
  std::int32_t step;    // from 1 on
  float rate;           // learning rate / (1 - beta1^step)
  float square_scale;   // 1 / (1 - beta2^step)
  float epsilon;
};

struct AdamKernel {
  // Updates rows[i], for i in [0, count), by gradients[i] (count, 8); resets gradients and places to zero.
  void (*move)(const AdamStep&, const std::int32_t* rows, float* gradients, std::int64_t count);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  AdamKernel adam_kernel();          \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
