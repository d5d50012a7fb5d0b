// Lower bound for the time of the interpolation: the same rows are read, and gradients are added to the same rows, but
// rows and weights are known in advance. Point n has, at each of 3 levels, 12 rows of 8 floats and their weights.
// test_kernels.py compiles this file for the machine, and checks its results.
#include <omp.h>
#include <string.h>

#include <cstdint>

namespace {

constexpr int kLevels = 3, kPlanes = 3, kPerPlane = 4, kDim = 8;
constexpr int kPerLevel = kPlanes * kPerPlane, kPerPoint = kLevels * kPerLevel, kOutDim = kLevels * kDim;

typedef float Row __attribute__((vector_size(kDim * sizeof(float))));

inline Row load(const float* row) {
  Row values;
  memcpy(&values, row, sizeof values);
  return values;
}

inline void store(float* row, Row values) { memcpy(row, &values, sizeof values); }

inline std::int64_t offset(std::int32_t row) { return static_cast<std::int64_t>(row) * kDim; }

// Planes are numbered over all levels.
inline void scatter(const std::int32_t* rows, const float* weights, const float* __restrict out_grad,
                    std::int64_t begin, std::int64_t end, int first_plane, int last_plane, float* __restrict gradient) {
  for (std::int64_t n = begin; n < end; ++n) {
    for (int plane = first_plane; plane < last_plane; ++plane) {
      const Row grad = load(out_grad + n * kOutDim + plane / kPlanes * kDim);
      for (int k = plane * kPerPlane; k < (plane + 1) * kPerPlane; ++k) {
        float* row = gradient + offset(rows[n * kPerPoint + k]);
        store(row, load(row) + weights[n * kPerPoint + k] * grad);
      }
    }
  }
}

}  // namespace

extern "C" {

void gather(const float* features, const std::int32_t* rows, const float* weights, std::int64_t count, float* out,
            int threads) {
#pragma omp parallel for num_threads(threads) schedule(static)
  for (std::int64_t n = 0; n < count; ++n) {
    for (int level = 0; level < kLevels; ++level) {
      Row sum = {};
#pragma GCC unroll 12
      for (int k = level * kPerLevel; k < (level + 1) * kPerLevel; ++k) {
        sum += weights[n * kPerPoint + k] * load(features + offset(rows[n * kPerPoint + k]));
      }
      store(out + n * kOutDim + level * kDim, sum);
    }
  }
}

// Each thread has a part of the points and its own gradient. gradients: (threads, num_rows, 8) zeros; the first becomes
// the sum.
void scatter_to_copies(const std::int32_t* rows, const float* weights, const float* out_grad, std::int64_t count,
                       float* gradients, std::int64_t num_rows, int threads) {
#pragma omp parallel num_threads(threads)
  {
    const std::int64_t own = omp_get_thread_num();
    scatter(rows, weights, out_grad, count * own / threads, count * (own + 1) / threads, 0, kLevels * kPlanes,
            gradients + own * num_rows * kDim);
#pragma omp barrier
#pragma omp for schedule(static)
    for (std::int64_t i = 0; i < num_rows * kDim; ++i) {
      for (int copy = 1; copy < threads; ++copy) gradients[i] += gradients[copy * num_rows * kDim + i];
    }
  }
}

// Each thread has all points, but only some planes. Planes share no rows, so there is one gradient without copies, as
// in csrc/field/encodings.cpp.
void scatter_by_planes(const std::int32_t* rows, const float* weights, const float* out_grad, std::int64_t count,
                       float* gradient, int threads) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int plane = kLevels * kPlanes - 1; plane >= 0; --plane) {
    scatter(rows, weights, out_grad, 0, count, plane, plane + 1, gradient);
  }
}

}  // extern "C"
