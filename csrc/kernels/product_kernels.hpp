// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Products of small matrices that stay in the cache, compiled once for each instruction set (see
// interpolation_kernels.hpp): what the layers of a network are made of, with what comes before and after.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kColumnBlock = 16;  // columns are padded to a multiple: whole vectors on every processor

// c[r][n] = finish(start + sum_k a[r][k] b[k][n])
template <typename T>
struct Product {
  const T* a;
  std::int64_t a_row, a_depth;  // distances between rows and between columns: either may be 1, for a transpose
  const T* b;                   // rows of `columns` numbers, b_row apart
  std::int64_t b_row;
  T* c;  // like b
  std::int64_t c_row;
  std::int64_t rows, depth;
  std::int64_t columns;  // a multiple of kColumnBlock
  bool add;              // start with what is in c,
  const T* biases;       // or with these numbers in each row; null: with zeros
  bool rectify;          // finish(x) = max(x, 0); NaN stays
  const T* positive;     // finish(x) = x where this is positive, like c, else 0: the gradient of `rectify`; or null
  std::int64_t positive_row;
};

template <typename T>
struct ProductKernel {
  void (*multiply)(const Product<T>&);
};

#define RADARSDF_DECLARE_KERNEL(isa) \
  namespace isa {                    \
  template <typename T>              \
  ProductKernel<T> product_kernel(); \
  }
RADARSDF_DECLARE_KERNEL(baseline)
RADARSDF_DECLARE_KERNEL(avx2)
RADARSDF_DECLARE_KERNEL(avx512)
#undef RADARSDF_DECLARE_KERNEL

}  // namespace radarsdf
