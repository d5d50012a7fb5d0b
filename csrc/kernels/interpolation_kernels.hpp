// Serial interpolation kernels on a range of points, compiled once for each instruction set from one source
// (interpolation_kernels.cpp). Only plain data here: the linker might keep the copy of an inline library function that
// was compiled for a newer processor.
#pragma once

#include <cstdint>

#include "kernels/adam_kernels.hpp"

namespace radarsdf {

// With F the features of the corners of the point's cell and w(x) the corner weights, a level's output is
//   y = sum_k W_k F_k,   W = w(x), or with `directions` v: W = dw/dx . v   (metres).
// The first and second derivatives for autograd are the same sums with other arrays in place of F and v.
template <typename T>
struct Interpolation {
  const std::int32_t* faces;    // see VertexTable
  const std::int32_t* rows;     // see VertexTable
  const std::int32_t* located;  // (n, num_levels) cell of each point; -1: none (VertexTable::locate)
  const T* points;              // (n, 3) local frame, m
  const T* directions;          // (n, 3), or null
  int num_levels;
  T inverse_leaf_size;  // 1/m
};

// Compact sums of the rows that a batch touches, in order of first touch. They are contiguous and stay in the cache;
// sums indexed by row would be scattered over the memory of a large map.
template <typename T>
struct RowSums {
  RowState* states;    // of all rows
  std::int32_t* rows;  // touched rows; capacity for one more
  T* sums;             // (count, 8), zero beyond
  std::int64_t count;
};

template <typename T>
struct InterpolationKernels {
  // out (n, num_levels * 8), rows `stride` apart. Zero for points without a cell.
  void (*interpolate)(const Interpolation<T>&, const T* features, T* out, std::int64_t stride, std::int64_t begin,
                      std::int64_t end);
  // features_grad (rows, 8) += W^T out_grad, for one level and one group of corners (a plane, or all of space):
  // different (level, group) touch different rows.
  void (*scatter)(const Interpolation<T>&, const T* out_grad, std::int64_t stride, T* features_grad, int level,
                  int group, std::int64_t begin, std::int64_t end);
  // The same into the compact sums of touched rows.
  void (*scatter_rows)(const Interpolation<T>&, const T* out_grad, std::int64_t stride, RowSums<T>& touched, int level,
                       int group, std::int64_t begin, std::int64_t end);
  // points_grad (n, 3) = d(out . out_grad)/dx, 1/m.
  void (*coordinate_gradient)(const Interpolation<T>&, const T* features, const T* out_grad, std::int64_t stride,
                              T* points_grad, std::int64_t begin, std::int64_t end);
};

#define RADARSDF_DECLARE_KERNELS(isa)                                      \
  namespace isa {                                                          \
  template <typename T>                                                    \
  const InterpolationKernels<T>& interpolation_kernels(Encoding encoding); \
  }
RADARSDF_DECLARE_KERNELS(baseline)
RADARSDF_DECLARE_KERNELS(avx2)
RADARSDF_DECLARE_KERNELS(avx512)
#undef RADARSDF_DECLARE_KERNELS

}  // namespace radarsdf
