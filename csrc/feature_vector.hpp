// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Eight features as one vector, for kernels that are compiled once for each instruction set. Internal linkage, so that
// no copy takes the place of another's.
#pragma once

#include <string.h>  // not <cstring>: see fourier_kernels.cpp

#include "cell.hpp"

#ifndef RADARSDF_ISA
#error "RADARSDF_ISA names the instruction set that this copy is compiled for"
#endif

namespace radarsdf::RADARSDF_ISA {
namespace {

// The features of one vertex as one vector: left to itself, the compiler unrolls eight floats into scalars.
#if defined(__GNUC__)
template <typename T>
struct VectorOf {
  typedef T Type __attribute__((vector_size(kFeatureDim * sizeof(T))));
};
#else
template <typename T>
struct VectorOf {
  struct Type {
    T lanes[kFeatureDim];
    T operator[](int i) const { return lanes[i]; }
  };
};
template <typename V>
inline V operator*(V a, V b) {
  for (int i = 0; i < kFeatureDim; ++i) a.lanes[i] *= b.lanes[i];
  return a;
}
template <typename T, typename V>
inline V operator*(T a, V b) {
  for (int i = 0; i < kFeatureDim; ++i) b.lanes[i] *= a;
  return b;
}
template <typename V>
inline V operator+(V a, V b) {
  for (int i = 0; i < kFeatureDim; ++i) a.lanes[i] += b.lanes[i];
  return a;
}
template <typename V>
inline V operator-(V a, V b) {
  for (int i = 0; i < kFeatureDim; ++i) a.lanes[i] -= b.lanes[i];
  return a;
}
template <typename V>
inline V& operator+=(V& a, V b) {
  return a = a + b;
}
#endif
template <typename T>
using Features = typename VectorOf<T>::Type;

// Rows are aligned to the size of a number only.
template <typename T>
inline Features<T> load(const T* row) {
  Features<T> features;
  memcpy(&features, row, sizeof features);
  return features;
}

template <typename T>
inline void store(T* row, Features<T> features) {
  memcpy(row, &features, sizeof features);
}

}  // namespace
}  // namespace radarsdf::RADARSDF_ISA
