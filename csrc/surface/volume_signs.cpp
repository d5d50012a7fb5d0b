#include "surface/volume_signs.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

// flags: word_bits bytes, 0 or 1. The product gathers the lowest bits of eight bytes in its top byte.
inline uint32_t pack_flags(const std::uint8_t* flags) {
  uint32_t word = 0;
  for (int group = 0; group < word_bits; group += 8) {
    uint64_t bytes = 0;
    for (int b = 0; b < 8; ++b) bytes |= static_cast<uint64_t>(flags[group + b]) << (8 * b);
    word |= static_cast<uint32_t>((bytes * 0x0102040810204080u) >> 56) << group;
  }
  return word;
}

// Writes test(k) for k in [0, size) as bits, and the word of zeros. Bytes first, because compilers vectorise them.
template <typename Test>
void write_bits(int64_t size, uint32_t* words, const Test& test) {
  std::uint8_t flags[word_bits];
  int64_t k = 0;
  for (; k + word_bits <= size; k += word_bits) {
    for (int64_t b = 0; b < word_bits; ++b) flags[b] = test(k + b);
    *words++ = pack_flags(flags);
  }
  if (k < size) {
    std::fill(flags, flags + word_bits, std::uint8_t{0});
    for (int64_t b = 0; k + b < size; ++b) flags[b] = test(k + b);
    *words++ = pack_flags(flags);
  }
  *words = 0;
}

// Largest T <= level, so that sample > level is equivalent to sample > T: float samples need no conversion.
template <typename T>
T round_down(double level) {
  constexpr T infinity = std::numeric_limits<T>::infinity();
  if (level > static_cast<double>(std::numeric_limits<T>::max())) return std::numeric_limits<T>::max();
  if (level < -static_cast<double>(std::numeric_limits<T>::max())) return -infinity;
  const T rounded = static_cast<T>(level);
  return static_cast<double>(rounded) <= level ? rounded : std::nextafter(rounded, -infinity);
}

}  // namespace

template <typename T>
VolumeSigns read_signs(const T* volume, const std::array<int64_t, 3>& shape, const bool* mask, double level,
                       int num_threads) {
  // Not a structured binding: a C++17 lambda cannot capture one, which clang rejects.
  const int64_t nx = shape[0], ny = shape[1], nz = shape[2];
  VolumeSigns signs{shape, BitVolume(shape), {}};
  const T threshold = round_down<T>(level);
  std::vector<std::uint8_t> plane_has_nan(nx);
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    bool has_nan = false;
    for (int64_t j = 0; j < ny; ++j) {
      const T* row = volume + (i * ny + j) * nz;
      write_bits(nz, signs.positive.row(i, j), [&](int64_t k) { return row[k] > threshold; });
      int row_has_nan = 0;
      for (int64_t k = 0; k < nz; ++k) row_has_nan |= row[k] != row[k];
      has_nan |= row_has_nan != 0;
    }
    plane_has_nan[i] = has_nan;
  });
  if (!mask && std::find(plane_has_nan.begin(), plane_has_nan.end(), 1) == plane_has_nan.end()) return signs;

  BitVolume usable(shape);
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    for (int64_t j = 0; j < ny; ++j) {
      const T* row = volume + (i * ny + j) * nz;
      const bool* flags = mask ? mask + (i * ny + j) * nz : nullptr;
      write_bits(nz, usable.row(i, j), [&](int64_t k) { return row[k] == row[k] && (!flags || flags[k]); });
    }
  });
  signs.cells = BitVolume(shape);
  parallel_tasks(nx, num_threads, [&](int64_t i) {
    for (int64_t j = 0; j < ny; ++j) {
      const bool has_cells = i + 1 < nx && j + 1 < ny;
      uint32_t* cells = signs.cells.row(i, j);
      for (int64_t m = 0; m < usable.windows(); ++m) {
        if (!has_cells) {
          cells[m] = 0;
          continue;
        }
        const uint64_t all = window(usable.row(i, j), m) & window(usable.row(i, j + 1), m) &
                             window(usable.row(i + 1, j), m) & window(usable.row(i + 1, j + 1), m);
        cells[m] = static_cast<uint32_t>(all & all >> 1);
      }
      cells[usable.windows()] = 0;
    }
  });
  return signs;
}

template VolumeSigns read_signs(const float*, const std::array<int64_t, 3>&, const bool*, double, int);
template VolumeSigns read_signs(const double*, const std::array<int64_t, 3>&, const bool*, double, int);

}  // namespace radarsdf
