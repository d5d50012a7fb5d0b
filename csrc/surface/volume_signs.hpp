// Signs of a volume's samples, one bit each, for marching cubes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>

namespace radarsdf {

constexpr std::int64_t word_bits = 32;

// One bit for each sample of a volume, or for the cell with this lower corner. A row ends with a word of zeros, so that
// a window may begin in any word before it.
class BitVolume {
 public:
  BitVolume() = default;
  explicit BitVolume(const std::array<std::int64_t, 3>& shape)
      : rows_per_plane_(shape[1]),
        words_((shape[2] + word_bits - 1) / word_bits + 1),
        bits_(new std::uint32_t[shape[0] * shape[1] * words_]) {}

  std::uint32_t* row(std::int64_t i, std::int64_t j) { return bits_.get() + (i * rows_per_plane_ + j) * words_; }
  const std::uint32_t* row(std::int64_t i, std::int64_t j) const {
    return bits_.get() + (i * rows_per_plane_ + j) * words_;
  }
  std::int64_t windows() const { return words_ - 1; }
  explicit operator bool() const { return bits_ != nullptr; }

 private:
  std::int64_t rows_per_plane_ = 0;
  std::int64_t words_ = 0;
  std::unique_ptr<std::uint32_t[]> bits_;
};

// 64 bits from word m on: those of 32 samples and of the next 32.
inline std::uint64_t window(const std::uint32_t* row, std::int64_t m) {
  return row[m] | static_cast<std::uint64_t>(row[m + 1]) << word_bits;
}

// Signs of samples (> level), and cells in use; `cells` is empty if all are.
struct VolumeSigns {
  std::array<std::int64_t, 3> shape;
  BitVolume positive;
  BitVolume cells;
};

// Arguments as for marching_cubes_dense.
template <typename T>
VolumeSigns read_signs(const T* volume, const std::array<std::int64_t, 3>& shape, const bool* mask, double level,
                       int num_threads);

}  // namespace radarsdf
