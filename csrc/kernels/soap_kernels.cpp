#include "kernels/soap_kernels.hpp"

#include <math.h>  // not <cmath>: see fourier_kernels.cpp

#include "kernels/vector.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

void add(const float* gradient, float beta, float epsilon, float* means, float* squares, float* ways,
         std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) {
    const float g = gradient[i];
    means[i] = beta * means[i] + (1 - beta) * g;
    squares[i] = beta * squares[i] + (1 - beta) * g * g;
    ways[i] = means[i] / (sqrtf(squares[i]) + epsilon);
  }
}

void scale(float* numbers, float factor, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) numbers[i] *= factor;
}

constexpr int kLanes = 8;

// Dot product of full vectors in several accumulators: a single one would be bound by the latency of additions.
float dot(const float* a, const float* b, std::int64_t count) {
  using Vector = VectorOf<float, kLanes>::Type;
  Vector sums{};
  for (std::int64_t i = 0; i < count; i += kLanes) sums += load_vector<Vector>(a + i) * load_vector<Vector>(b + i);
  float sum = 0;
  for (int lane = 0; lane < kLanes; ++lane) sum += sums[lane];
  return sum;
}

bool orthonormalise(float* rows, std::int64_t count, std::int64_t stride) {
  for (std::int64_t i = 0; i < count; ++i) {
    float* row = rows + i * stride;
    for (int pass = 0; pass < 2; ++pass) {  // the second pass removes rounding errors of the first
      for (std::int64_t j = 0; j < i; ++j) {
        const float* before = rows + j * stride;
        const float share = dot(row, before, stride);
        for (std::int64_t k = 0; k < stride; ++k) row[k] -= share * before[k];
      }
      const float length = sqrtf(dot(row, row, stride));
      if (!(length > 0 && length < INFINITY)) return false;
      scale(row, 1 / length, stride);
    }
  }
  return true;
}

}  // namespace

SoapKernels soap_kernels() { return {add, scale, orthonormalise}; }

}  // namespace radarsdf::RADARSDF_ISA
