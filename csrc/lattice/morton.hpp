// Integer lattice coordinates as one sortable 64-bit key: 21 bits per axis, interleaved (Morton order), so that spatial
// neighbours are close in memory and the key of the parent cell is `key >> 3`.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kAxisBits = 21;
// Offset of a signed lattice coordinate before packing. Divisible by 2^level for every level, so that shifting a biased
// coordinate is the floor division that yields the parent.
constexpr std::int32_t kAxisBias = 1 << (kAxisBits - 1);

// Without SSE4.1 (the baseline) std::floor is a library call.
template <typename Integer = std::int32_t, typename T>
inline Integer floor_to_int(T value) {
  const auto truncated = static_cast<Integer>(value);
  return truncated - static_cast<Integer>(value < static_cast<T>(truncated));
}

// Spreads the low 21 bits of v to every third bit.
inline std::uint64_t spread_bits(std::uint64_t v) {
  v &= 0x1fffff;
  v = (v | v << 32) & 0x001f00000000ffff;
  v = (v | v << 16) & 0x001f0000ff0000ff;
  v = (v | v << 8) & 0x100f00f00f00f00f;
  v = (v | v << 4) & 0x10c30c30c30c30c3;
  v = (v | v << 2) & 0x1249249249249249;
  return v;
}

inline std::uint32_t compact_bits(std::uint64_t v) {
  v &= 0x1249249249249249;
  v = (v | v >> 2) & 0x10c30c30c30c30c3;
  v = (v | v >> 4) & 0x100f00f00f00f00f;
  v = (v | v >> 8) & 0x001f0000ff0000ff;
  v = (v | v >> 16) & 0x001f00000000ffff;
  v = (v | v >> 32) & 0x1fffff;
  return static_cast<std::uint32_t>(v);
}

// Biased coordinates in [0, 2^21).
inline std::uint64_t morton_key(std::uint32_t x, std::uint32_t y, std::uint32_t z) {
  return spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2;
}

// Key of signed lattice coordinates. The bias of leaf cells is kAxisBias.
inline std::uint64_t lattice_key(const std::int32_t* cell, std::int32_t bias = kAxisBias) {
  return morton_key(static_cast<std::uint32_t>(cell[0] + bias), static_cast<std::uint32_t>(cell[1] + bias),
                    static_cast<std::uint32_t>(cell[2] + bias));
}

// Key of the neighbour one step (1 or -1) along an axis. Spreading the bits of all axes takes four times as long.
inline std::uint64_t morton_neighbour(std::uint64_t key, int axis, std::int32_t step) {
  const std::uint64_t unit = std::uint64_t{1} << axis, bits = std::uint64_t{0x1249249249249249} << axis;
  // A carry propagates through set bits of the other axes, a borrow through cleared ones.
  const std::uint64_t moved = step > 0 ? (key | ~bits) + unit : (key & bits) - unit;
  return (key & ~bits) | (moved & bits);
}

inline std::uint32_t morton_coordinate(std::uint64_t key, int axis) { return compact_bits(key >> axis); }

// Signed coordinate of a leaf cell.
inline std::int32_t lattice_coordinate(std::uint64_t key, int axis) {
  return static_cast<std::int32_t>(morton_coordinate(key, axis)) - kAxisBias;
}

}  // namespace radarsdf
