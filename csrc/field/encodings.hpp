// Multi-threaded encodings of a batch of points, by the kernels of the instruction set in use. All arrays are in C
// order; `stride` is the distance between rows, so that encodings can be written side by side into one matrix.
#pragma once

#include <cstdint>

#include "field/level_tasks.hpp"
#include "field/point_batch.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

template <typename T>
void locate(const VertexTable& table, const T* points, std::int64_t count, std::int32_t* located, int num_threads);

// Locates and interpolates in one pass.
template <typename T>
void encode(const VertexTable& table, const T* features, const T* points, std::int64_t count, std::int32_t* located,
            T* out, std::int64_t stride, int num_threads);

template <typename T>
void interpolate(const VertexTable& table, const T* features, const PointBatch<T>& batch, T* out, std::int64_t stride,
                 int num_threads);

// Adds to features_grad (num_rows, 8), in the order of the points for any number of threads.
template <typename T>
void scatter(const VertexTable& table, const PointBatch<T>& batch, const T* out_grad, std::int64_t stride,
             T* features_grad, int num_threads);
// One of the tasks of `scatter`, see level_tasks.hpp.
template <typename T>
void scatter_task(const VertexTable& table, const PointBatch<T>& batch, const T* out_grad, std::int64_t stride,
                  T* features_grad, LevelTask task);

template <typename T>
void coordinate_gradient(const VertexTable& table, const T* features, const PointBatch<T>& batch, const T* out_grad,
                         std::int64_t stride, T* points_grad, int num_threads);

// Moves points (count, 3) within step_m of a face into an adjacent leaf cell, the first of eight shifts by step_m,
// unless they are in one; inside (count): whether they are in a leaf cell now.
void into_cells(const VertexTable& table, float* points, std::int64_t count, float step_m, bool* inside,
                int num_threads);

// out (count, 4): trilinear interpolation of values (num_rows,) of an octree of one level, and its gradient; 0 outside
// the cells. Rounded like PyTorch's lerp with FMA, and its gradient.
void trilinear(const VertexTable& table, const float* values, const float* points, std::int64_t count, float* out,
               int num_threads);

template <typename T>
void fourier(const T* points, std::int64_t count, double half_width_m, int first_frequency, int num_frequencies, T* out,
             std::int64_t stride, int num_threads);

constexpr int kHarmonics = 16;  // degrees 0 to 3

// Real spherical harmonics of degree 0..3 of unit vectors (count, 3): out (count, 16), in the order l, m = -l..l.
template <typename T>
void spherical_harmonics(const T* directions, std::int64_t count, T* out, std::int64_t stride, int num_threads);

}  // namespace radarsdf
