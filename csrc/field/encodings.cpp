#include "field/encodings.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels/fourier_kernels.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

// About 50 us of work; waking a thread takes a few us.
constexpr std::int64_t kMinPoints = 512;

}  // namespace

template <typename T>
void locate(const VertexTable& table, const T* points, std::int64_t count, std::int32_t* located, int num_threads) {
  parallel_blocks(count, kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    table.locate(points + 3 * begin, end - begin, located + begin * table.num_levels());
  });
}

template <typename T>
void encode(const VertexTable& table, const T* features, const T* points, std::int64_t count, std::int32_t* located,
            T* out, std::int64_t stride, int num_threads) {
  const InterpolationKernels<T>& kernels = RADARSDF_KERNEL(interpolation_kernels<T>)(table.encoding());
  const Interpolation<T> in = interpolation<T>(table, {points, nullptr, located, count});
  parallel_blocks(count, kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    constexpr std::int64_t kBlock = 256;  // located cells are still in the L1 cache when they are used
    for (std::int64_t first = begin; first < end; first += kBlock) {
      const std::int64_t last = std::min(end, first + kBlock);
      table.locate(points + 3 * first, last - first, located + first * table.num_levels());
      kernels.interpolate(in, features, out, stride, first, last);
    }
  });
}

template <typename T>
void interpolate(const VertexTable& table, const T* features, const PointBatch<T>& batch, T* out, std::int64_t stride,
                 int num_threads) {
  const InterpolationKernels<T>& kernels = RADARSDF_KERNEL(interpolation_kernels<T>)(table.encoding());
  const Interpolation<T> in = interpolation(table, batch);
  parallel_blocks(batch.count, kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    kernels.interpolate(in, features, out, stride, begin, end);
  });
}

template <typename T>
void scatter(const VertexTable& table, const PointBatch<T>& batch, const T* out_grad, std::int64_t stride,
             T* features_grad, int num_threads) {
  const int threads = batch.count < kMinPoints ? 1 : num_threads;
  parallel_tasks(num_level_tasks(table), threads, [&](std::int64_t task) {
    scatter_task(table, batch, out_grad, stride, features_grad, level_task(table, task));
  });
}

template <typename T>
void scatter_task(const VertexTable& table, const PointBatch<T>& batch, const T* out_grad, std::int64_t stride,
                  T* features_grad, LevelTask task) {
  const InterpolationKernels<T>& kernels = RADARSDF_KERNEL(interpolation_kernels<T>)(table.encoding());
  kernels.scatter(interpolation(table, batch), out_grad, stride, features_grad, task.level, task.group, 0, batch.count);
}

template <typename T>
void coordinate_gradient(const VertexTable& table, const T* features, const PointBatch<T>& batch, const T* out_grad,
                         std::int64_t stride, T* points_grad, int num_threads) {
  const InterpolationKernels<T>& kernels = RADARSDF_KERNEL(interpolation_kernels<T>)(table.encoding());
  const Interpolation<T> in = interpolation(table, batch);
  parallel_blocks(batch.count, kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    kernels.coordinate_gradient(in, features, out_grad, stride, points_grad, begin, end);
  });
}

void into_cells(const VertexTable& table, float* points, std::int64_t count, float step_m, bool* inside,
                int num_threads) {
  const auto leaf_m = static_cast<float>(table.leaf_size_m());
  const auto near_face = [&](float x) { return std::abs(x / leaf_m - std::nearbyint(x / leaf_m)) * leaf_m <= step_m; };
  std::vector<std::int32_t> located(count * table.num_levels());
  locate(table, points, count, located.data(), num_threads);
  parallel_for(count, kMinPoints, num_threads, [&](std::int64_t i) {
    float* p = points + 3 * i;
    inside[i] = located[i * table.num_levels()] >= 0;
    if (inside[i] || !(near_face(p[0]) || near_face(p[1]) || near_face(p[2]))) return;
    for (int shift = 0; shift < 8 && !inside[i]; ++shift) {
      std::int32_t cells[kMaxLevels];
      float moved[3];
      for (int axis = 0; axis < 3; ++axis) moved[axis] = p[axis] + (shift << axis & 4 ? step_m : -step_m);
      table.locate(moved, 1, cells);
      inside[i] = cells[0] >= 0;
      if (inside[i]) std::copy_n(moved, 3, p);
    }
  });
}

void trilinear(const VertexTable& table, const float* values, const float* points, std::int64_t count, float* out,
               int num_threads) {
  const auto inverse = static_cast<float>(1.0 / table.leaf_size_m());
  const auto lerp = [](float a, float b, float x) {
    return x < 0.5F ? std::fma(x, b - a, a) : std::fma(x - 1, b - a, b);
  };
  std::vector<std::int32_t> located(count);
  locate(table, points, count, located.data(), num_threads);
  parallel_for(count, kMinPoints, num_threads, [&](std::int64_t i) {
    const std::int32_t cell = located[i];
    float *to = out + 4 * i, u[3], at_x[4], along_x[4], at_y[2], along_y[2];
    std::fill_n(to, 4, 0.0F);
    if (cell < 0) return;
    for (int axis = 0; axis < 3; ++axis) {
      const float place = points[3 * i + axis] * inverse;
      u[axis] = place - std::floor(place);
    }
    const std::int32_t* rows = table.rows_of(cell);  // the first axis is fastest
    for (int yz = 0; yz < 4; ++yz) {
      const float *low = values + rows[yz << 1], *high = values + rows[yz << 1 | 1];
      at_x[yz] = lerp(*low, *high, u[0]);
      along_x[yz] = *high - *low;
    }
    for (int z = 0; z < 2; ++z) {
      at_y[z] = lerp(at_x[2 * z], at_x[2 * z + 1], u[1]);
      along_y[z] = at_x[2 * z + 1] - at_x[2 * z];
    }
    to[0] = lerp(at_y[0], at_y[1], u[2]);
    const float y[2] = {1 - u[1], u[1]}, z[2] = {1 - u[2], u[2]};
    for (int corner = 0; corner < 4; ++corner)  // PyTorch sums in C order
      to[1] += z[corner & 1] * y[corner >> 1] * along_x[(corner & 1) << 1 | corner >> 1];
    to[2] = z[0] * along_y[0] + z[1] * along_y[1];
    to[3] = at_y[1] - at_y[0];
    for (int axis = 0; axis < 3; ++axis) to[1 + axis] *= inverse;
  });
}

template <typename T>
void fourier(const T* points, std::int64_t count, double half_width_m, int first_frequency, int num_frequencies, T* out,
             std::int64_t stride, int num_threads) {
  const FourierKernel<T> kernel = RADARSDF_KERNEL(fourier_kernel<T>)();
  parallel_blocks(count, kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    kernel.encode(points, static_cast<T>(1.0 / half_width_m), first_frequency, num_frequencies, out, stride, begin,
                  end);
  });
}

template <typename T>
void spherical_harmonics(const T* directions, std::int64_t count, T* out, std::int64_t stride, int num_threads) {
  parallel_for(count, 4 * kMinPoints, num_threads, [&](std::int64_t n) {
    const T x = directions[3 * n], y = directions[3 * n + 1], z = directions[3 * n + 2];
    const T xx = x * x, yy = y * y, zz = z * z;
    // sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!), times sqrt(2) if m != 0, times the Legendre factor.
    const T values[16] = {T(0.28209479177387814),
                          T(0.4886025119029199) * y,
                          T(0.4886025119029199) * z,
                          T(0.4886025119029199) * x,
                          T(1.0925484305920792) * x * y,
                          T(1.0925484305920792) * y * z,
                          T(0.31539156525252005) * (2 * zz - xx - yy),
                          T(1.0925484305920792) * x * z,
                          T(0.5462742152960396) * (xx - yy),
                          T(0.5900435899266435) * y * (3 * xx - yy),
                          T(2.890611442640554) * x * y * z,
                          T(0.4570457994644658) * y * (4 * zz - xx - yy),
                          T(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy),
                          T(0.4570457994644658) * x * (4 * zz - xx - yy),
                          T(1.445305721320277) * z * (xx - yy),
                          T(0.5900435899266435) * x * (xx - 3 * yy)};
    std::copy(values, values + 16, out + n * stride);
  });
}

#define RADARSDF_INSTANTIATE(T)                                                                                     \
  template void locate(const VertexTable&, const T*, std::int64_t, std::int32_t*, int);                             \
  template void encode(const VertexTable&, const T*, const T*, std::int64_t, std::int32_t*, T*, std::int64_t, int); \
  template void interpolate(const VertexTable&, const T*, const PointBatch<T>&, T*, std::int64_t, int);             \
  template void scatter(const VertexTable&, const PointBatch<T>&, const T*, std::int64_t, T*, int);                 \
  template void scatter_task(const VertexTable&, const PointBatch<T>&, const T*, std::int64_t, T*, LevelTask);      \
  template void coordinate_gradient(const VertexTable&, const T*, const PointBatch<T>&, const T*, std::int64_t, T*, \
                                    int);                                                                           \
  template void fourier(const T*, std::int64_t, double, int, int, T*, std::int64_t, int);                           \
  template void spherical_harmonics(const T*, std::int64_t, T*, std::int64_t, int);
RADARSDF_INSTANTIATE(float)
RADARSDF_INSTANTIATE(double)
#undef RADARSDF_INSTANTIATE

}  // namespace radarsdf
