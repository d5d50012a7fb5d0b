#include "field/encodings.hpp"

#include <algorithm>

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
  parallel_blocks(count, 4 * kMinPoints, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t n = begin; n < end; ++n) {
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
    }
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
