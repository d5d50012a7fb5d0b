// Bit operations that C++17 lacks (C++20: std::countr_zero and std::popcount).
#pragma once

#include <cstdint>

#ifdef _MSC_VER
#include <intrin.h>
#endif

namespace radarsdf {

// Position of the lowest set bit; bits must not be 0.
inline int lowest_bit(std::uint64_t bits) {
#ifdef _MSC_VER
  unsigned long position = 0;
  _BitScanForward64(&position, bits);
  return static_cast<int>(position);
#else
  return __builtin_ctzll(bits);
#endif
}

// Sums pairs, then nibbles, then bytes: the x86-64 baseline has no instruction for it, and the library call is slower.
inline int count_bits(std::uint64_t bits) {
  bits -= (bits >> 1) & 0x5555555555555555u;
  bits = (bits & 0x3333333333333333u) + ((bits >> 2) & 0x3333333333333333u);
  bits = (bits + (bits >> 4)) & 0x0f0f0f0f0f0f0f0fu;
  return static_cast<int>((bits * 0x0101010101010101u) >> 56);
}

// Adds a number to a hash.
inline std::uint64_t mixed(std::uint64_t hash, std::uint64_t number) {
  hash = (hash ^ number) * 0x9e3779b97f4a7c15;  // 2^64 over the golden ratio, odd
  return hash ^ hash >> 32;
}

}  // namespace radarsdf
