// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "kernels/adam_kernels.hpp"

#include <math.h>  // not <cmath>: see fourier_kernels.cpp

#include "kernels/feature_vector.hpp"
#include "util/prefetch.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

inline float root(float v) { return sqrtf(v); }
inline double root(double v) { return sqrt(v); }

constexpr std::int64_t kBlock = 16;  // rows per block, processed as one long vector loop

template <typename T>
void move(const AdamStep<T>& adam, const std::int32_t* rows, T* gradients, std::int64_t count) {
  constexpr int kNumbers = kBlock * kFeatureDim;
  const T mean_share = 1 - adam.decays[2], square_share = 1 - adam.decays[3];
  const T rate = adam.rate, square_scale = adam.square_scale, epsilon = adam.epsilon;
  T mean[kNumbers] = {}, square[kNumbers] = {}, gradient[kNumbers] = {}, way[kNumbers];
  for (std::int64_t first = 0; first < count; first += kBlock) {
    const std::int64_t size = count - first < kBlock ? count - first : kBlock;
    for (std::int64_t i = first + 2 * kBlock; i < first + 3 * kBlock && i < count; ++i) {
      prefetch(adam.marks + rows[i]);
      prefetch(adam.moments + rows[i] * std::int64_t{2 * kFeatureDim});
      prefetch(adam.features + rows[i] * std::int64_t{kFeatureDim});
    }
    for (std::int64_t i = 0; i < size; ++i) {
      const std::int32_t row = rows[first + i];
      const std::int32_t steps = adam.step - adam.marks[row].last_step;
      adam.marks[row] = {adam.step, 0};
      const Features<T> moments[2] = {
          adam.decays[2 * steps] * load(adam.moments + row * std::int64_t{2 * kFeatureDim}),
          adam.decays[2 * steps + 1] * load(adam.moments + row * std::int64_t{2 * kFeatureDim} + kFeatureDim)};
      store(mean + i * kFeatureDim, moments[0]);
      store(square + i * kFeatureDim, moments[1]);
      T* sum = gradients + (first + i) * kFeatureDim;
      store(gradient + i * kFeatureDim, load(sum));
      store(sum, Features<T>{});
    }
    for (int d = 0; d < kNumbers; ++d) {
      const T g = gradient[d];
      mean[d] += mean_share * g;
      square[d] += square_share * g * g;
      way[d] = rate * mean[d] / (root(square_scale * square[d]) + epsilon);
    }
    for (std::int64_t i = 0; i < size; ++i) {
      const std::int32_t row = rows[first + i];
      T* moments = adam.moments + row * std::int64_t{2 * kFeatureDim};
      store(moments, load(mean + i * kFeatureDim));
      store(moments + kFeatureDim, load(square + i * kFeatureDim));
      T* feature = adam.features + row * std::int64_t{kFeatureDim};
      store(feature, load(feature) - load(way + i * kFeatureDim));
    }
  }
}

}  // namespace

template <typename T>
AdamKernel<T> adam_kernel() {
  return {move<T>};
}

template AdamKernel<float> adam_kernel();
template AdamKernel<double> adam_kernel();

}  // namespace radarsdf::RADARSDF_ISA
