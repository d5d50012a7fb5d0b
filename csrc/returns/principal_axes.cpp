#include "returns/principal_axes.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int kMaxSweeps = 30;  // four or five suffice: convergence is quadratic

// Jacobi rotation in the plane of the axes p and q that annihilates a[p][q] (Golub and Van Loan, Matrix
// Computations, 8.5).
void rotate(double (&a)[3][3], double (&v)[3][3], int p, int q) {
  if (a[p][q] == 0) return;
  const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
  const double t = std::copysign(1 / (std::abs(theta) + std::sqrt(theta * theta + 1)), theta);
  const double c = 1 / std::sqrt(t * t + 1), s = t * c;
  a[p][p] -= t * a[p][q];
  a[q][q] += t * a[p][q];
  a[p][q] = a[q][p] = 0;
  const int r = 3 - p - q;
  const double rp = a[r][p], rq = a[r][q];
  a[r][p] = a[p][r] = c * rp - s * rq;
  a[r][q] = a[q][r] = s * rp + c * rq;
  for (auto& row : v) {
    const double vp = row[p], vq = row[q];
    row[p] = c * vp - s * vq;
    row[q] = s * vp + c * vq;
  }
}

}  // namespace

void principal_axes(const double* matrices, std::int64_t count, double* values, double* vectors, int num_threads) {
  parallel_for(count, 1 << 9, num_threads, [&](std::int64_t m) {
    double a[3][3], v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, total = 0;
    for (int i = 0; i < 3; ++i) {
      for (int j = i; j < 3; ++j) {
        a[i][j] = a[j][i] = matrices[9 * m + 3 * i + j];
        total += std::abs(a[i][j]);
      }
    }
    const double negligible = total * std::numeric_limits<double>::epsilon() * 1e-3;
    bool is_finite = std::isfinite(total);
    for (int sweep = 0; is_finite && sweep < kMaxSweeps; ++sweep) {
      if (std::abs(a[0][1]) + std::abs(a[0][2]) + std::abs(a[1][2]) <= negligible) break;
      rotate(a, v, 0, 1);
      rotate(a, v, 0, 2);
      rotate(a, v, 1, 2);
    }
    int order[3] = {0, 1, 2};
    if (a[order[1]][order[1]] < a[order[0]][order[0]]) std::swap(order[0], order[1]);
    if (a[order[2]][order[2]] < a[order[1]][order[1]]) std::swap(order[1], order[2]);
    if (a[order[1]][order[1]] < a[order[0]][order[0]]) std::swap(order[0], order[1]);
    const double nan = std::numeric_limits<double>::quiet_NaN();
    for (int k = 0; k < 3; ++k) {
      values[3 * m + k] = is_finite ? a[order[k]][order[k]] : nan;
      for (int i = 0; i < 3; ++i) vectors[9 * m + 3 * i + k] = is_finite ? v[i][order[k]] : nan;
    }
  });
}

}  // namespace radarsdf
