// Symmetric band matrices of 6 x 6 blocks, one row of blocks for each scan's pose: Cholesky factors, and the band of
// the inverse.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

constexpr int kPose = 6;  // degrees of freedom of a pose: translation, rotation
constexpr int kBlock = kPose * kPose;

// Lower triangle; blocks in C order.
class BlockBand {
 public:
  // `rows` rows of up to `width` blocks left of the diagonal, and that on it: (rows, width + 1, 6, 6); null: 0.
  BlockBand(std::int64_t rows, std::int64_t width, const double* blocks = nullptr);

  std::int64_t width() const { return width_; }

  // Block in this row and column, row - width <= column <= row.
  double* block(std::int64_t row, std::int64_t column) { return &blocks_[offset(row, column)]; }
  const double* block(std::int64_t row, std::int64_t column) const { return &blocks_[offset(row, column)]; }
  std::int64_t first_column(std::int64_t row) const { return row > width_ ? row - width_ : 0; }

  // In-place Cholesky factorisation L L^T. False if not positive definite; the contents are then invalid.
  bool factor();

  // Of a factor: replaces x (rows, 6) by (L L^T)^-1 x.
  void solve(double* x) const;

  // Of a factor: the blocks of (L L^T)^-1 within the band (Takahashi et al. 1973).
  BlockBand inverse() const;

 private:
  std::size_t offset(std::int64_t row, std::int64_t column) const {
    return static_cast<std::size_t>(kBlock * ((width_ + 1) * row + column - row + width_));
  }

  std::int64_t rows_, width_;
  std::vector<double> blocks_;
};

}  // namespace radarsdf
