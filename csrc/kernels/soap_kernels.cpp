#include "kernels/soap_kernels.hpp"

#include <math.h>  // not <cmath>: see fourier_kernels.cpp

#include "kernels/vector.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

inline float root(float v) { return sqrtf(v); }
inline double root(double v) { return sqrt(v); }

template <typename T>
void add(const T* gradient, T beta, T epsilon, T* means, T* squares, T* ways, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) {
    const T g = gradient[i];
    means[i] = beta * means[i] + (1 - beta) * g;
    squares[i] = beta * squares[i] + (1 - beta) * g * g;
    ways[i] = means[i] / (root(squares[i]) + epsilon);
  }
}

template <typename T>
void scale(T* numbers, T factor, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) numbers[i] *= factor;
}

constexpr int kLanes = 8;

// Dot product of full vectors in several accumulators: a single one would be bound by the latency of additions.
template <typename T>
T dot(const T* a, const T* b, std::int64_t count) {
  using Vector = typename VectorOf<T, kLanes>::Type;
  Vector sums{};
  for (std::int64_t i = 0; i < count; i += kLanes) sums += load_vector<Vector>(a + i) * load_vector<Vector>(b + i);
  T sum = 0;
  for (int lane = 0; lane < kLanes; ++lane) sum += sums[lane];
  return sum;
}

template <typename T>
bool orthonormalise(T* rows, std::int64_t count, std::int64_t stride) {
  for (std::int64_t i = 0; i < count; ++i) {
    T* row = rows + i * stride;
    for (int pass = 0; pass < 2; ++pass) {  // the second pass removes rounding errors of the first
      for (std::int64_t j = 0; j < i; ++j) {
        const T* before = rows + j * stride;
        const T share = dot(row, before, stride);
        for (std::int64_t k = 0; k < stride; ++k) row[k] -= share * before[k];
      }
      const T length = root(dot(row, row, stride));
      if (!(length > 0 && length < T(INFINITY))) return false;
      scale(row, 1 / length, stride);
    }
  }
  return true;
}

}  // namespace

template <typename T>
SoapKernels<T> soap_kernels() {
  return {add<T>, scale<T>, orthonormalise<T>};
}

template SoapKernels<float> soap_kernels();
template SoapKernels<double> soap_kernels();

}  // namespace radarsdf::RADARSDF_ISA
