// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The derivatives of marching cubes' vertices by the samples. A vertex depends on two samples, and up to six vertices
// depend on a sample. Each sample collects its own sum, in the order of the vertices: no two threads write to one
// sample, and the bits do not depend on the number of threads.
#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <stdexcept>
#include <vector>

#include "surface/marching_cubes.hpp"
#include "surface/marching_cubes_common.hpp"
#include "util/large_array.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

using std::int32_t;
using std::int64_t;
using std::size_t;

constexpr int64_t min_parallel_samples = 1 << 14;

struct EdgeGradient {
  double lower = 0;
  double upper = 0;
};

// By the samples a and b of an edge, given the derivative `grad` by the fraction of the way between them. With
// fraction = (level - a) / (b - a), the fraction's derivatives are -(1 - fraction) / (b - a) and -fraction / (b - a).
inline EdgeGradient edge_gradient(double a, double b, double level, double grad) {
  const double fraction = edge_fraction(a, b, level);
  const double difference = b - a;
  const bool follows = fraction > min_edge_fraction && fraction < 1 - min_edge_fraction && std::isfinite(difference);
  if (!follows) return {};
  const double pull = -grad / difference;  // 0 of a gradient of 0, however small the difference
  return {(1 - fraction) * pull, fraction * pull};
}

[[noreturn]] void refuse_edges() { throw std::invalid_argument("the edges are not those of a mesh of these samples"); }

}  // namespace

// The edges of a plane's vertices end in this plane or, along x, in the next one. So a plane of samples collects from
// its own vertices and from those of the plane before.
template <typename T>
void marching_cubes_dense_backward(const T* volume, const std::array<int64_t, 3>& shape, const int64_t* edges,
                                   const double* vertices_grad, int64_t num_vertices,
                                   const std::array<double, 3>& spacing, double level, T* volume_grad,
                                   int num_threads) {
  const std::array<int64_t, 3> strides{shape[1] * shape[2], shape[2], 1};
  const int64_t plane = strides[0];
  if (shape[0] * plane == 0 && num_vertices > 0) refuse_edges();
  // First vertex of each plane, and the end.
  std::vector<int64_t> first(static_cast<size_t>(shape[0]) + 1);
  for (int64_t i = 0; i <= shape[0]; ++i) {
    first[static_cast<size_t>(i)] = std::lower_bound(edges, edges + num_vertices, 3 * i * plane) - edges;
  }
  if (first.front() != 0 || first.back() != num_vertices) refuse_edges();

  const auto gradient = [&](int64_t v, int64_t lower, size_t axis) {
    const double grad = vertices_grad[3 * v + static_cast<int64_t>(axis)] * spacing[axis];
    return edge_gradient(static_cast<double>(volume[lower]), static_cast<double>(volume[lower + strides[axis]]), level,
                         grad);
  };
  // To wake threads takes longer than a few thousand samples.
  const int threads = shape[0] * plane < min_parallel_samples ? 1 : num_threads;
  parallel_tasks(shape[0], threads, [&](int64_t i) {
    const int64_t begin = i * plane;
    const int64_t end = begin + plane;
    std::fill(volume_grad + begin, volume_grad + end, T{0});
    if (i > 0) {
      for (int64_t v = first[static_cast<size_t>(i) - 1]; v < first[static_cast<size_t>(i)]; ++v) {
        if (edges[v] % 3 != 0) continue;
        const int64_t lower = edges[v] / 3;
        if (lower < begin - plane || lower >= begin) refuse_edges();
        volume_grad[lower + plane] += static_cast<T>(gradient(v, lower, 0).upper);
      }
    }
    for (int64_t v = first[static_cast<size_t>(i)]; v < first[static_cast<size_t>(i) + 1]; ++v) {
      const auto axis = static_cast<size_t>(edges[v] % 3);
      const int64_t lower = edges[v] / 3;
      const int64_t upper_end = axis == 0 ? shape[0] * plane : end;
      if (lower < begin || lower >= end || lower + strides[axis] >= upper_end) refuse_edges();
      const EdgeGradient grad = gradient(v, lower, axis);
      volume_grad[lower] += static_cast<T>(grad.lower);
      if (axis != 0) volume_grad[lower + strides[axis]] += static_cast<T>(grad.upper);
    }
  });
}

// The vertices are in the order of their lower corners. A corner is the upper one of at most three edges, one along
// each axis, which are noted first.
template <typename T>
void marching_cubes_sparse_backward(const T* values, int64_t num_corners, const int64_t* edges, const int32_t* uppers,
                                    const double* vertices_grad, int64_t num_vertices,
                                    const std::array<double, 3>& spacing, double level, T* values_grad,
                                    int num_threads) {
  constexpr int64_t block_size = 1 << 14;
  constexpr int32_t no_vertex = -1;
  if (num_vertices > std::numeric_limits<int32_t>::max()) refuse_edges();
  const auto for_each_block = [&](int64_t size, const auto& task) {
    parallel_tasks((size + block_size - 1) / block_size, num_threads, [&](int64_t block) {
      task(static_cast<size_t>(block), block * block_size, std::min(size, (block + 1) * block_size));
    });
  };

  // No two vertices write to one place, unless a corner was given twice, which is found below: the atomics make that
  // well defined.
  const auto vertex_below = large_array<std::atomic<int32_t>>(3 * num_corners);
  for_each_block(3 * num_corners, [&](size_t, int64_t begin, int64_t end) {
    for (int64_t e = begin; e < end; ++e) {
      vertex_below[static_cast<size_t>(e)].store(no_vertex, std::memory_order_relaxed);
    }
  });
  for_each_block(num_vertices, [&](size_t, int64_t begin, int64_t end) {
    for (int64_t v = begin; v < end; ++v) {
      const int64_t before = v > 0 ? edges[v - 1] : -1;
      if (edges[v] <= before || edges[v] >= 3 * num_corners || uppers[v] < 0 || uppers[v] >= num_corners) {
        refuse_edges();
      }
      const int64_t edge_below = 3 * int64_t{uppers[v]} + edges[v] % 3;
      vertex_below[static_cast<size_t>(edge_below)].store(static_cast<int32_t>(v), std::memory_order_relaxed);
    }
  });

  const auto gradient = [&](int64_t v) {
    const int64_t axis = edges[v] % 3;
    const double grad = vertices_grad[3 * v + axis] * spacing[static_cast<size_t>(axis)];
    return edge_gradient(static_cast<double>(values[edges[v] / 3]), static_cast<double>(values[uppers[v]]), level,
                         grad);
  };
  std::vector<int64_t> found(static_cast<size_t>((num_corners + block_size - 1) / block_size));
  for_each_block(num_corners, [&](size_t block, int64_t begin, int64_t end) {
    int64_t above = std::lower_bound(edges, edges + num_vertices, 3 * begin) - edges;
    for (int64_t c = begin; c < end; ++c) {
      double sum = 0;
      for (; above < num_vertices && edges[above] < 3 * (c + 1); ++above) sum += gradient(above).lower;
      for (int64_t e = 3 * c; e < 3 * (c + 1); ++e) {
        const int32_t below = vertex_below[static_cast<size_t>(e)].load(std::memory_order_relaxed);
        if (below == no_vertex) continue;
        sum += gradient(below).upper;
        ++found[block];
      }
      values_grad[c] = static_cast<T>(sum);
    }
  });
  if (std::accumulate(found.begin(), found.end(), int64_t{0}) != num_vertices) {
    throw std::invalid_argument("a corner occurs twice: two edges along one axis end there");
  }
}

template void marching_cubes_dense_backward(const float*, const std::array<int64_t, 3>&, const int64_t*, const double*,
                                            int64_t, const std::array<double, 3>&, double, float*, int);
template void marching_cubes_dense_backward(const double*, const std::array<int64_t, 3>&, const int64_t*, const double*,
                                            int64_t, const std::array<double, 3>&, double, double*, int);
template void marching_cubes_sparse_backward(const float*, int64_t, const int64_t*, const int32_t*, const double*,
                                             int64_t, const std::array<double, 3>&, double, float*, int);
template void marching_cubes_sparse_backward(const double*, int64_t, const int64_t*, const int32_t*, const double*,
                                             int64_t, const std::array<double, 3>&, double, double*, int);

}  // namespace radarsdf
