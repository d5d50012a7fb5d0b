#include "kernels/adam_kernels.hpp"

#include <math.h>  // not <cmath>: see fourier_kernels.cpp

#include "kernels/feature_vector.hpp"
#include "util/prefetch.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

constexpr std::int64_t kBlock = 16;  // rows per block, whose roots are computed in one vector loop

inline float mean_square(const float* gradient) {
  float sums[4];
  for (int d = 0; d < 4; ++d) sums[d] = gradient[d] * gradient[d] + gradient[d + 4] * gradient[d + 4];
  return ((sums[0] + sums[1]) + (sums[2] + sums[3])) / kFeatureDim;
}

void move(const AdamStep& adam, const std::int32_t* rows, float* gradients, std::int64_t count) {
  const float mean_share = 1 - adam.decays[2], square_share = 1 - adam.decays[3];
  float square[kBlock] = {}, rate[kBlock];
  for (std::int64_t first = 0; first < count; first += kBlock) {
    const std::int64_t size = count - first < kBlock ? count - first : kBlock;
    for (std::int64_t i = first + 2 * kBlock; i < first + 3 * kBlock && i < count; ++i) {
      prefetch(adam.states + rows[i]);
      prefetch(adam.features + rows[i] * std::int64_t{kFeatureDim});
    }
    for (std::int64_t i = 0; i < size; ++i) {
      const RowState& state = adam.states[rows[first + i]];
      const float decay = adam.decays[2 * std::int64_t{adam.step - state.last_step} + 1];
      square[i] = decay * state.square + square_share * mean_square(gradients + (first + i) * kFeatureDim);
    }
    for (int i = 0; i < kBlock; ++i) rate[i] = adam.rate / (sqrtf(adam.square_scale * square[i]) + adam.epsilon);
    for (std::int64_t i = 0; i < size; ++i) {
      const std::int32_t row = rows[first + i];
      RowState& state = adam.states[row];
      float *gradient = gradients + (first + i) * kFeatureDim,
            *feature = adam.features + row * std::int64_t{kFeatureDim};
      const float decay = adam.decays[2 * std::int64_t{adam.step - state.last_step}];
      const Features<float> mean = decay * load_rounded(state.mean) + mean_share * load(gradient);
      store(feature, load(feature) - rate[i] * mean);
      store(gradient, Features<float>{});
      store_rounded(state.mean, mean);
      state.square = square[i];
      state.last_step = adam.step;
      state.place = 0;
    }
  }
}

}  // namespace

AdamKernel adam_kernel() { return {move}; }

}  // namespace radarsdf::RADARSDF_ISA
