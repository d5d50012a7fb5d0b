// Products of small matrices that fit the cache, with the prologue and epilogue of a network layer, compiled once for
// each instruction set (see interpolation_kernels.hpp).
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kColumnBlock = 16;  // columns are padded to a multiple, whole vectors for every instruction set

// c[r][n] = finish(start + sum_k a[r][k] b[k][n])
template <typename T>
struct Product {
  const T* a;
  std::int64_t a_row, a_depth;  // strides of rows and columns: either may be 1, for a transpose
  const T* b;                   // rows of `columns` numbers, stride b_row
  std::int64_t b_row;
  T* c;  // like b
  std::int64_t c_row;
  std::int64_t rows, depth;
  std::int64_t columns;  // a multiple of kColumnBlock
  bool add;              // start = c,
  const T* biases;       // else start = biases in each row; null: 0
  bool rectify;          // finish(x) = max(x, 0); NaN stays
  const T* positive;     // or null. finish(x) = x where this, laid out like c, is positive, else 0: gradient of ReLU
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
