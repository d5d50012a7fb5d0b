#include "field/soap.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "field/padding.hpp"
#include "kernels/product_kernels.hpp"
#include "kernels/soap_kernels.hpp"
#include "util/instruction_set.hpp"

namespace radarsdf {
namespace {

constexpr double kBeta = 0.95;  // decay of means, squares and sums, as published
// Steps between updates of the bases; initially after 1, 2, 4 and so on. Measured: intervals of 10, as published, and
// of 30 train equally well.
constexpr std::int64_t kTurnEvery = 32;
// Fraction of the mean eigenvalue added to all: without it, rounding makes axes with zero gradients lose
// orthogonality.
constexpr double kRidge = 1e-3;
// Fraction of the RMS gradient: gradients along axes with less may be rounding errors, which Adam would scale to a full
// step.
constexpr double kFloor = 1e-2;
constexpr double kLeast = 1e-15;            // epsilon for zero gradients, as for Adam
constexpr std::int64_t kLongestSide = 512;  // updates of the bases take cubic time

bool has_basis(std::int64_t side) { return side <= kLongestSide; }

// Size of a square matrix for one side; 0 without a basis.
std::int64_t square_size(std::int64_t side) { return has_basis(side) ? side * padded(side) : 0; }

// Matrix of rows padded with zeros.
struct Matrix {
  float* data;
  std::int64_t rows, columns;

  std::int64_t stride() const { return padded(columns); }
  std::int64_t size() const { return rows * stride(); }
  float* row(std::int64_t r) const { return data + r * stride(); }
};

Matrix zeros_in(std::vector<float>& numbers, std::int64_t rows, std::int64_t columns) {
  numbers.assign(rows * padded(columns), 0.0F);
  return {numbers.data(), rows, columns};
}

void transpose(Matrix from, Matrix to) {
  for (std::int64_t r = 0; r < from.rows; ++r) {
    for (std::int64_t c = 0; c < from.columns; ++c) to.row(c)[r] = from.row(r)[c];
  }
}

double trace(Matrix square) {
  double sum = 0;
  for (std::int64_t i = 0; i < square.rows; ++i) sum += static_cast<double>(square.row(i)[i]);
  return sum;
}

class Soap {
 public:
  explicit Soap(const SoapMatrix& matrix) : matrix_(matrix) {
    const std::int64_t rows = matrix.rows, columns = matrix.columns;
    float* next = matrix.memory;
    const auto take = [&next](std::int64_t side, std::int64_t width) {
      const Matrix taken{next, side, width};
      next += taken.size();
      return taken;
    };
    means_ = take(rows, columns);
    squares_ = take(rows, columns);
    if (has_basis(rows)) {
      left_sum_ = take(rows, rows);
      left_ = take(rows, rows);
    }
    if (has_basis(columns)) {
      right_sum_ = take(columns, columns);
      right_ = take(columns, columns);
      right_transposed_ = take(columns, columns);
    }
    gradient_ = zeros_in(gradient_numbers_, rows, columns);
    half_ = zeros_in(half_numbers_, rows, columns);
    turned_ = zeros_in(turned_numbers_, rows, columns);
  }

  void step(std::int64_t number, double learning_rate) {
    for (std::int64_t r = 0; r < matrix_.rows; ++r) {
      std::copy_n(matrix_.gradient + r * matrix_.columns, matrix_.columns, gradient_.row(r));
    }
    if (number == 1) {
      begin(left_);
      begin(right_);
      begin(right_transposed_);
    }
    add_to_sums();
    const bool is_power_of_two = (number & (number - 1)) == 0;
    if (number % kTurnEvery == 0 || (number < kTurnEvery && is_power_of_two)) turn();
    into_bases(gradient_, turned_);
    kernels_.add(turned_.data, static_cast<float>(kBeta), epsilon(), means_.data, squares_.data, turned_.data,
                 turned_.size());
    out_of_bases(turned_, gradient_);
    // Bias correction: means are too small by 1 - beta^number, roots of squares by its square root.
    const double grown = 1 - std::pow(kBeta, static_cast<double>(number));
    const float rate = static_cast<float>(learning_rate / std::sqrt(grown));
    for (std::int64_t r = 0; r < matrix_.rows; ++r) {
      float* weights = matrix_.weights + r * matrix_.columns;
      for (std::int64_t c = 0; c < matrix_.columns; ++c) weights[c] -= rate * gradient_.row(r)[c];
    }
  }

 private:
  static void begin(Matrix basis) {
    if (!basis.data) return;
    for (std::int64_t i = 0; i < basis.rows; ++i) basis.row(i)[i] = 1;
  }

  // c = a b, or a' b; adds to c if `add`.
  void multiply(Matrix a, bool transposed, Matrix b, Matrix c, bool add = false) const {
    Product<float> product{};
    product.a = a.data;
    product.a_row = transposed ? 1 : a.stride();
    product.a_depth = transposed ? a.stride() : 1;
    product.b = b.data;
    product.b_row = b.stride();
    product.c = c.data;
    product.c_row = product.columns = c.stride();
    product.rows = c.rows;
    product.depth = b.rows;
    product.add = add;
    product_kernel_.multiply(product);
  }

  void add_to_sums() {
    if (left_.data) {
      const Matrix transposed = zeros_in(scratch_, matrix_.columns, matrix_.rows);
      transpose(gradient_, transposed);
      kernels_.scale(left_sum_.data, static_cast<float>(kBeta), left_sum_.size());
      multiply(gradient_, false, transposed, left_sum_, true);
    }
    if (right_.data) {
      kernels_.scale(right_sum_.data, static_cast<float>(kBeta), right_sum_.size());
      multiply(gradient_, true, gradient_, right_sum_, true);
    }
  }

  // Rotations preserve the sum of squares, so that of the gradient is the trace of either sum.
  float epsilon() const {
    const Matrix sum = left_.data ? left_sum_ : right_sum_;
    const double mean_square =
        sum.data ? (1 - kBeta) * trace(sum) / static_cast<double>(matrix_.rows * matrix_.columns) : 0;
    return static_cast<float>(kFloor * std::sqrt(mean_square) + kLeast);
  }

  // Rows of a basis are its vectors: turned = left G right'.
  void into_bases(Matrix from, Matrix to) {
    if (left_.data) multiply(left_, false, from, half_);
    const Matrix half = left_.data ? half_ : from;
    if (right_.data) {
      multiply(half, false, right_transposed_, to);
    } else {
      std::copy_n(half.data, half.size(), to.data);
    }
  }

  void out_of_bases(Matrix from, Matrix to) {
    if (right_.data) multiply(from, false, right_, half_);
    const Matrix half = right_.data ? half_ : from;
    if (left_.data) {
      multiply(left_, true, half, to);
    } else {
      std::copy_n(half.data, half.size(), to.data);
    }
  }

  // One step of subspace iteration towards the eigenvectors, which change slowly. Means are rotated; squares, as
  // published, are not.
  void turn() {
    out_of_bases(means_, turned_);
    turn_basis(left_sum_, left_);
    turn_basis(right_sum_, right_);
    if (right_.data) transpose(right_, right_transposed_);
    into_bases(turned_, means_);
  }

  void turn_basis(Matrix sum, Matrix basis) {
    if (!basis.data) return;
    const auto scale = static_cast<float>(static_cast<double>(sum.rows) / trace(sum));
    if (!(std::isfinite(scale) && scale > 0)) return;
    const Matrix next = zeros_in(scratch_, basis.rows, basis.columns);
    multiply(basis, false, sum, next);
    for (std::int64_t i = 0; i < next.size(); ++i)
      next.data[i] = scale * next.data[i] + static_cast<float>(kRidge) * basis.data[i];
    if (kernels_.orthonormalise(next.data, next.rows, next.stride())) std::copy_n(next.data, next.size(), basis.data);
  }

  const SoapMatrix& matrix_;
  Matrix means_{}, squares_{};                                               // moments of gradients in the bases
  Matrix left_sum_{}, left_{}, right_sum_{}, right_{}, right_transposed_{};  // without data: identity
  std::vector<float> gradient_numbers_, half_numbers_, turned_numbers_, scratch_;
  Matrix gradient_{}, half_{}, turned_{};
  ProductKernel<float> product_kernel_ = RADARSDF_KERNEL(product_kernel<float>)();
  SoapKernels kernels_ = RADARSDF_KERNEL(soap_kernels)();
};

}  // namespace

std::int64_t soap_memory_size(std::int64_t rows, std::int64_t columns) {
  return 2 * rows * padded(columns) + 2 * square_size(rows) + 3 * square_size(columns);
}

void soap_step(const SoapMatrix& matrix, std::int64_t step, double learning_rate) {
  Soap(matrix).step(step, learning_rate);
}

}  // namespace radarsdf
