#include "poses/block_band.hpp"

#include <algorithm>
#include <cmath>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

// c -= a b^T.
void subtract_times_transposed(const double* a, const double* b, double* c) {
  double transposed[kBlock];
  for (int i = 0; i < kPose; ++i) {
    for (int j = 0; j < kPose; ++j) transposed[kPose * j + i] = b[kPose * i + j];
  }
  for (int i = 0; i < kPose; ++i) {
    for (int k = 0; k < kPose; ++k) {
      const double factor = a[kPose * i + k];
      for (int j = 0; j < kPose; ++j) c[kPose * i + j] -= factor * transposed[kPose * k + j];
    }
  }
}

// c -= a b, or a^T b.
template <bool Transposed>
void subtract_times(const double* a, const double* b, double* c) {
  for (int i = 0; i < kPose; ++i) {
    for (int k = 0; k < kPose; ++k) {
      const double factor = Transposed ? a[kPose * k + i] : a[kPose * i + k];
      for (int j = 0; j < kPose; ++j) c[kPose * i + j] -= factor * b[kPose * k + j];
    }
  }
}

// Replaces the lower triangle of a by its Cholesky factor, the rest by 0.
bool factor_block(double* a) {
  for (int j = 0; j < kPose; ++j) {
    double pivot = a[kPose * j + j];
    for (int k = 0; k < j; ++k) pivot -= a[kPose * j + k] * a[kPose * j + k];
    if (!(pivot > 0) || !std::isfinite(pivot)) return false;
    pivot = std::sqrt(pivot);
    a[kPose * j + j] = pivot;
    for (int i = j + 1; i < kPose; ++i) {
      double sum = a[kPose * i + j];
      for (int k = 0; k < j; ++k) sum -= a[kPose * i + k] * a[kPose * j + k];
      a[kPose * i + j] = sum / pivot;
      a[kPose * j + i] = 0;
    }
  }
  return true;
}

// Replaces a (6, 6) by a l^-T, or by a l^-1, with the lower triangle l.
void divide_by_transposed(double* a, const double* l) {
  for (int i = 0; i < kPose; ++i) {
    double* row = a + kPose * i;
    for (int j = 0; j < kPose; ++j) {
      for (int k = 0; k < j; ++k) row[j] -= row[k] * l[kPose * j + k];
      row[j] /= l[kPose * j + j];
    }
  }
}

void divide_by(double* a, const double* l) {
  for (int i = 0; i < kPose; ++i) {
    double* row = a + kPose * i;
    for (int j = kPose - 1; j >= 0; --j) {
      for (int k = j + 1; k < kPose; ++k) row[j] -= row[k] * l[kPose * k + j];
      row[j] /= l[kPose * j + j];
    }
  }
}

}  // namespace

BlockBand::BlockBand(std::int64_t rows, std::int64_t width, const double* blocks)
    : rows_(rows),
      width_(std::clamp<std::int64_t>(width, 0, std::max<std::int64_t>(rows - 1, 0))),
      blocks_(static_cast<std::size_t>(kBlock * rows_ * (width_ + 1))) {
  if (blocks != nullptr) std::copy(blocks, blocks + blocks_.size(), blocks_.begin());
}

bool BlockBand::factor() {
  for (std::int64_t i = 0; i < rows_; ++i) {
    check_interrupt();
    for (std::int64_t j = first_column(i); j <= i; ++j) {
      double* entry = block(i, j);
      for (std::int64_t k = std::max(first_column(i), first_column(j)); k < j; ++k) {
        subtract_times_transposed(block(i, k), block(j, k), entry);
      }
      if (j < i) {
        divide_by_transposed(entry, block(j, j));
      } else if (!factor_block(entry)) {
        return false;
      }
    }
  }
  return true;
}

void BlockBand::solve(double* x) const {
  for (std::int64_t i = 0; i < rows_; ++i) {
    double* own = x + kPose * i;
    for (std::int64_t j = first_column(i); j < i; ++j) {
      const double *l = block(i, j), *other = x + kPose * j;
      for (int a = 0; a < kPose; ++a) {
        for (int b = 0; b < kPose; ++b) own[a] -= l[kPose * a + b] * other[b];
      }
    }
    const double* l = block(i, i);
    for (int a = 0; a < kPose; ++a) {
      for (int b = 0; b < a; ++b) own[a] -= l[kPose * a + b] * own[b];
      own[a] /= l[kPose * a + a];
    }
  }
  for (std::int64_t i = rows_ - 1; i >= 0; --i) {
    double* own = x + kPose * i;
    const double* l = block(i, i);
    for (int a = kPose - 1; a >= 0; --a) {
      for (int b = a + 1; b < kPose; ++b) own[a] -= l[kPose * b + a] * own[b];
      own[a] /= l[kPose * a + a];
    }
    for (std::int64_t j = first_column(i); j < i; ++j) {
      const double* below = block(i, j);
      double* other = x + kPose * j;
      for (int a = 0; a < kPose; ++a) {
        for (int b = 0; b < kPose; ++b) other[b] -= below[kPose * a + b] * own[a];
      }
    }
  }
}

BlockBand BlockBand::inverse() const {
  BlockBand z(rows_, width_);
  // Columns in reverse order: Z_ij is the sum over k > j of -Z_ik Y_kj, with Y_kj = L_kj L_jj^-1.
  std::vector<double> y(kBlock * (width_ + 1));
  for (std::int64_t j = rows_ - 1; j >= 0; --j) {
    check_interrupt();
    const std::int64_t last = std::min(rows_ - 1, j + width_);
    for (std::int64_t k = j + 1; k <= last; ++k) {
      double* yk = &y[kBlock * (k - j)];
      std::copy(block(k, j), block(k, j) + kBlock, yk);
      divide_by(yk, block(j, j));
    }
    for (std::int64_t i = j + 1; i <= last; ++i) {
      double* entry = z.block(i, j);
      for (std::int64_t k = j + 1; k <= last; ++k) {
        const double* yk = &y[kBlock * (k - j)];
        if (k <= i) {
          subtract_times<false>(z.block(i, k), yk, entry);
        } else {
          subtract_times<true>(z.block(k, i), yk, entry);
        }
      }
    }
    double* diagonal = z.block(j, j);
    for (int a = 0; a < kPose; ++a) diagonal[kPose * a + a] = 1;
    divide_by_transposed(diagonal, block(j, j));
    divide_by(diagonal, block(j, j));
    for (std::int64_t k = j + 1; k <= last; ++k) {
      subtract_times<true>(&y[kBlock * (k - j)], z.block(k, j), diagonal);
    }
    // Symmetric errors stay small, while antisymmetric ones grow with the squares of Y.
    for (int a = 0; a < kPose; ++a) {
      for (int b = 0; b < a; ++b) diagonal[kPose * a + b] = diagonal[kPose * b + a];
    }
  }
  return z;
}

}  // namespace radarsdf
