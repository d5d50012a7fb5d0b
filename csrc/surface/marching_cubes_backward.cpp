// Derivatives of the vertices of marching cubes by the samples. A vertex depends on two samples, and up to six vertices
// depend on a sample. Each sample gathers its own sum in the order of the vertices: threads write to disjoint samples,
// and results do not depend on the number of threads.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "surface/marching_cubes.hpp"
#include "surface/marching_cubes_common.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int64_t min_parallel_samples = 1 << 14;

struct EdgeGradient {
  double lower = 0;
  double upper = 0;
};

// Gradient by the samples a and b of an edge, given the derivative `grad` by the fraction (level - a) / (b - a), which
// has the derivatives -(1 - fraction) / (b - a) and -fraction / (b - a).
inline EdgeGradient edge_gradient(double a, double b, double level, double grad) {
  const double fraction = edge_fraction(a, b, level);
  const double difference = b - a;
  const bool follows = fraction > min_edge_fraction && fraction < 1 - min_edge_fraction && std::isfinite(difference);
  if (!follows) return {};
  const double pull = -grad / difference;  // 0 if the gradient is 0, at any difference
  return {(1 - fraction) * pull, fraction * pull};
}

[[noreturn]] void refuse_edges() { throw std::invalid_argument("the edges are not those of a mesh of these samples"); }

}  // namespace

// Edges of a plane's vertices end in this plane or, along x, in the next one. A plane of samples therefore gathers from
// its own vertices and from those of the previous plane.
template <typename T>
void marching_cubes_dense_backward(const T* volume, const std::array<int64_t, 3>& shape, const int64_t* edges,
                                   const double* vertices_grad, int64_t num_vertices,
                                   const std::array<double, 3>& spacing, double level, T* volume_grad,
                                   int num_threads) {
  const std::array<int64_t, 3> strides{shape[1] * shape[2], shape[2], 1};
  const int64_t plane = strides[0];
  if (shape[0] * plane == 0 && num_vertices > 0) refuse_edges();
  // First vertex of each plane, and the end.
  std::vector<int64_t> first(shape[0] + 1);
  for (int64_t i = 0; i <= shape[0]; ++i) {
    first[i] = std::lower_bound(edges, edges + num_vertices, 3 * i * plane) - edges;
  }
  if (first.front() != 0 || first.back() != num_vertices) refuse_edges();

  const auto gradient = [&](int64_t v, int64_t lower, size_t axis) {
    const double grad = vertices_grad[3 * v + static_cast<int64_t>(axis)] * spacing[axis];
    return edge_gradient(static_cast<double>(volume[lower]), static_cast<double>(volume[lower + strides[axis]]), level,
                         grad);
  };
  // Waking threads takes longer than a few thousand samples.
  const int threads = shape[0] * plane < min_parallel_samples ? 1 : num_threads;
  parallel_tasks(shape[0], threads, [&](int64_t i) {
    const int64_t begin = i * plane;
    const int64_t end = begin + plane;
    std::fill(volume_grad + begin, volume_grad + end, T{0});
    if (i > 0) {
      for (int64_t v = first[i - 1]; v < first[i]; ++v) {
        if (edges[v] % 3 != 0) continue;
        const int64_t lower = edges[v] / 3;
        if (lower < begin - plane || lower >= begin) refuse_edges();
        volume_grad[lower + plane] += static_cast<T>(gradient(v, lower, 0).upper);
      }
    }
    for (int64_t v = first[i]; v < first[i + 1]; ++v) {
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

template void marching_cubes_dense_backward(const float*, const std::array<int64_t, 3>&, const int64_t*, const double*,
                                            int64_t, const std::array<double, 3>&, double, float*, int);
template void marching_cubes_dense_backward(const double*, const std::array<int64_t, 3>&, const int64_t*, const double*,
                                            int64_t, const std::array<double, 3>&, double, double*, int);

}  // namespace radarsdf
