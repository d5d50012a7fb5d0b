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

// The same for a row in bfloat16, rounded to nearest even.
using FeatureBits = VectorOf<std::uint32_t, kFeatureDim>::Type;
using RoundedBits = VectorOf<std::uint16_t, kFeatureDim>::Type;

inline Features<float> load_rounded(const std::uint16_t* row) {
#if defined(__GNUC__)
  return reinterpret_cast<Features<float>>(__builtin_convertvector(load_vector<RoundedBits>(row), FeatureBits) << 16);
#else
  std::uint32_t bits[kFeatureDim];
  for (int d = 0; d < kFeatureDim; ++d) bits[d] = std::uint32_t{row[d]} << 16;
  Features<float> features;
  memcpy(&features, bits, sizeof bits);
  return features;
#endif
}

inline void store_rounded(std::uint16_t* row, Features<float> features) {
#if defined(__GNUC__)
  const auto bits = reinterpret_cast<FeatureBits>(features);
  store_vector(row, __builtin_convertvector((bits + 0x7fffu + (bits >> 16 & 1u)) >> 16, RoundedBits));
#else
  std::uint32_t bits[kFeatureDim];
  memcpy(bits, &features, sizeof bits);
  for (int d = 0; d < kFeatureDim; ++d)
    row[d] = static_cast<std::uint16_t>((bits[d] + 0x7fffu + (bits[d] >> 16 & 1u)) >> 16);
#endif
}

}  // namespace
}  // namespace radarsdf::RADARSDF_ISA
