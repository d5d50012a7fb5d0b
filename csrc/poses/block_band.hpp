// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Symmetric matrices of 6 x 6 blocks near the diagonal, one row of blocks for each scan's pose: their Cholesky factors,
// and the blocks of their inverses near the diagonal.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

constexpr int kPose = 6;  // numbers of a pose's increment: translation, rotation
constexpr int kBlock = kPose * kPose;

// A lower triangle. All blocks are in C order.
class BlockBand {
 public:
  // `rows` rows of blocks, of which each has `width` blocks left of the diagonal, or all that there are.
  BlockBand(std::int64_t rows, std::int64_t width);

  std::int64_t rows() const { return rows_; }
  std::int64_t width() const { return width_; }

  // The block in this row and column, row - width <= column <= row.
  double* block(std::int64_t row, std::int64_t column) { return &blocks_[offset(row, column)]; }
  const double* block(std::int64_t row, std::int64_t column) const { return &blocks_[offset(row, column)]; }
  std::int64_t first_column(std::int64_t row) const { return row > width_ ? row - width_ : 0; }

  // Becomes its Cholesky factor L: L L^T is what it was. False: it is not positive definite, and is destroyed.
  bool factor();

  // Of a factor: x (rows, 6) becomes (L L^T)^-1 x.
  void solve(double* x) const;

  // Of a factor: the blocks of (L L^T)^-1 within the band (Takahashi et al. 1973), without those outside of it.
  BlockBand inverse() const;

 private:
  std::size_t offset(std::int64_t row, std::int64_t column) const {
    return static_cast<std::size_t>(kBlock * ((width_ + 1) * row + column - row + width_));
  }

  std::int64_t rows_, width_;
  std::vector<double> blocks_;
};

}  // namespace radarsdf
