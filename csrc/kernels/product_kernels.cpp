#include "kernels/product_kernels.hpp"

#include "kernels/vector.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64, kRows = 8;
#elif defined(__AVX__)
constexpr int kVectorBytes = 32, kRows = 4;
#else
constexpr int kVectorBytes = 16, kRows = 4;
#endif
constexpr int kVectors =
    2;  // per row. Two FMA units with a latency of four need eight independent sums: at least kRows · kVectors

// Loops over a block's sums must be unrolled: otherwise the sums stay in memory.
#if defined(__GNUC__) && !defined(__clang__)
#define RADARSDF_UNROLL _Pragma("GCC unroll 16")
#else
#define RADARSDF_UNROLL
#endif

// Computes a block of c with its sums in registers.
template <int kBlockRows, int kBlockVectors, typename T>
inline void block(const Product<T>& p, std::int64_t row, std::int64_t column) {
  constexpr int kLanes = kVectorBytes / static_cast<int>(sizeof(T));
  using Vector = typename VectorOf<T, kLanes>::Type;
  const T* a = p.a + row * p.a_row;
  const T* b = p.b + column;
  T* c = p.c + row * p.c_row + column;
  // Copies, since a store to c could alias the product.
  const std::int64_t c_row = p.c_row, positive_row = p.positive_row;
  const T* positive = p.positive ? p.positive + row * positive_row + column : nullptr;
  const bool rectify = p.rectify;
  Vector sums[kBlockRows][kBlockVectors];
  RADARSDF_UNROLL
  for (int r = 0; r < kBlockRows; ++r) {
    RADARSDF_UNROLL
    for (int v = 0; v < kBlockVectors; ++v) {
      sums[r][v] = p.add      ? load_vector<Vector>(c + r * c_row + v * kLanes)
                   : p.biases ? load_vector<Vector>(p.biases + column + v * kLanes)
                              : Vector{};
    }
  }
  for (std::int64_t k = 0; k < p.depth; ++k, a += p.a_depth, b += p.b_row) {
    Vector factors[kBlockVectors];
    for (int v = 0; v < kBlockVectors; ++v) factors[v] = load_vector<Vector>(b + v * kLanes);
    for (int r = 0; r < kBlockRows; ++r) {
      const T factor = a[r * p.a_row];
      for (int v = 0; v < kBlockVectors; ++v) sums[r][v] += factor * factors[v];
    }
  }
  RADARSDF_UNROLL
  for (int r = 0; r < kBlockRows; ++r) {
    RADARSDF_UNROLL
    for (int v = 0; v < kBlockVectors; ++v) {
      Vector sum = sums[r][v];
      if (rectify) sum = not_negative<T>(sum);
      if (positive) sum = where_positive<T>(load_vector<Vector>(positive + r * positive_row + v * kLanes), sum);
      store_vector(c + r * c_row + v * kLanes, sum);
    }
  }
}

template <int kBlockVectors, typename T>
inline void columns(const Product<T>& p, std::int64_t column) {
  std::int64_t row = 0;
  for (; row + kRows <= p.rows; row += kRows) block<kRows, kBlockVectors>(p, row, column);
  for (; row < p.rows; ++row) block<1, kBlockVectors>(p, row, column);
}

template <typename T>
void multiply(const Product<T>& p) {
  constexpr std::int64_t kLanes = kVectorBytes / static_cast<std::int64_t>(sizeof(T));
  std::int64_t column = 0;
  for (; column + kVectors * kLanes <= p.columns; column += kVectors * kLanes) columns<kVectors>(p, column);
  for (; column < p.columns; column += kLanes) columns<1>(p, column);
}

}  // namespace

template <typename T>
ProductKernel<T> product_kernel() {
  return {multiply<T>};
}

template ProductKernel<float> product_kernel();
template ProductKernel<double> product_kernel();

}  // namespace radarsdf::RADARSDF_ISA
