// SIMD vectors for kernels that are compiled once for each instruction set. Internal linkage, so that the linker does
// not merge copies.
#pragma once

#include <string.h>  // not <cstring>: see fourier_kernels.cpp

#ifndef RADARSDF_ISA
#error "RADARSDF_ISA names the instruction set that this copy is compiled for"
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

// By default, compilers unroll short loops over elements into scalar code.
#if defined(__GNUC__)
template <typename T, int kLanes>
struct VectorOf {
  typedef T Type __attribute__((vector_size(kLanes * sizeof(T))));
};
template <typename T, typename V>
inline V where_positive(V condition, V value) {
  return condition > T(0) ? value : V{};
}
template <typename T, typename V>
inline V not_negative(V v) {
  return v < T(0) ? V{} : v;
}
#else
template <typename T, int kLanes>
struct VectorOf {
  struct Type {
    T lanes[kLanes];
    static constexpr int kCount = kLanes;
    T operator[](int i) const { return lanes[i]; }
  };
};
template <typename V>
inline V operator*(V a, V b) {
  for (int i = 0; i < V::kCount; ++i) a.lanes[i] *= b.lanes[i];
  return a;
}
template <typename T, typename V>
inline V operator*(T a, V b) {
  for (int i = 0; i < V::kCount; ++i) b.lanes[i] *= a;
  return b;
}
template <typename V>
inline V operator+(V a, V b) {
  for (int i = 0; i < V::kCount; ++i) a.lanes[i] += b.lanes[i];
  return a;
}
template <typename V>
inline V operator-(V a, V b) {
  for (int i = 0; i < V::kCount; ++i) a.lanes[i] -= b.lanes[i];
  return a;
}
template <typename V>
inline V& operator+=(V& a, V b) {
  return a = a + b;
}
template <typename T, typename V>
inline V where_positive(V condition, V value) {
  for (int i = 0; i < V::kCount; ++i) value.lanes[i] = condition.lanes[i] > 0 ? value.lanes[i] : T(0);
  return value;
}
template <typename T, typename V>
inline V not_negative(V v) {
  for (int i = 0; i < V::kCount; ++i) v.lanes[i] = v.lanes[i] < 0 ? T(0) : v.lanes[i];
  return v;
}
#endif

// Memory is aligned to the element size only.
template <typename V, typename T>
inline V load_vector(const T* numbers) {
  V v;
  memcpy(&v, numbers, sizeof v);
  return v;
}

template <typename V, typename T>
inline void store_vector(T* numbers, V v) {
  memcpy(numbers, &v, sizeof v);
}

}  // namespace
}  // namespace radarsdf::RADARSDF_ISA
