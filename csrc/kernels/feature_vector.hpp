// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The features of one vertex as a SIMD vector.
#pragma once

#include "kernels/vector.hpp"
#include "lattice/cell.hpp"

namespace radarsdf::RADARSDF_ISA {
namespace {

template <typename T>
using Features = typename VectorOf<T, kFeatureDim>::Type;

template <typename T>
inline Features<T> load(const T* row) {
  return load_vector<Features<T>>(row);
}

template <typename T>
inline void store(T* row, Features<T> features) {
  store_vector(row, features);
}

}  // namespace
}  // namespace radarsdf::RADARSDF_ISA
