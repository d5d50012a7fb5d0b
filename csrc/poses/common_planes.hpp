// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What returns of different scans on common planes say of the poses of these scans.
#pragma once

#include <cstdint>
#include <vector>

#include "poses/block_band.hpp"
#include "returns/return_noise.hpp"

namespace radarsdf {

// Returns in the local frame, m, scan by scan.
struct PosedReturns {
  const float* points;         ///< (count, 3)
  const float* directions;     ///< (count, 3), unit, from the sensor
  const float* ranges_m;       ///< (count)
  const std::int32_t* scans;   ///< (count), ascending
  const std::int32_t* planes;  ///< (count), the plane of each return, -1: none
  std::int64_t count;
  const double* positions;   ///< (scans, 3), of the sensor
  const double* up_of_scan;  ///< (scans, 3), the z axis of the sensor
  std::int64_t num_scans;
};

struct PlanesOfScans {
  const double* centres;  ///< (count, 3), local frame, m
  const double* normals;  ///< (count, 3), unit
  std::int64_t count;
  double extent_m;  ///< of a plane: a tilt moves its border by about so much
};

// The residual of a return is its distance from its plane, n (x - c) - (offset + tilts of the plane), over the
// deviation of its noise along n; its weight is that of Geman and McClure. A plane's offset and two tilts are unknown,
// too, and are eliminated (Schur complement): what remains is what the returns of a plane say of each other's poses.
// Planes that only one scan sees say nothing. The unknowns are left increments of poses about the position of the
// sensor: a translation, and a rotation vector, in the local frame.
class CommonPlanes {
 public:
  // At most `scans_together` neighbouring scans share a plane in the band of the matrix that is factored.
  CommonPlanes(const PosedReturns& returns, const PlanesOfScans& planes, const ReturnVariances& noise,
               std::int64_t scans_together, int num_threads);

  // Median of the squared residuals over their variances, over that of a normal distribution; at least 1. All variances
  // are multiplied by it: while the poses are wrong, so are the residuals.
  double scale() const { return scale_; }
  std::int64_t num_used() const { return num_used_; }  // returns on planes of two scans or more
  const std::vector<double>& weights() const {
    return weights_;
  }  // (scans), sum of the weights of its returns, in [0, 1] each

  // Solves (H + P) x = -(g + q) for the increments x (scans, 6): H and g are of the planes; P (prior) is block
  // tridiagonal, diagonal (scans, 6, 6), below (scans - 1, 6, 6), and q (scans, 6) its gradient. By conjugate
  // gradients, preconditioned by the factor of a band of the matrix, which is exact where no plane is seen by scans
  // that are far apart. If `inverse_diagonal` (scans, 6, 6) is given, it and `inverse_below` (scans - 1, 6, 6) become
  // blocks of the inverse of that band: at least the covariance. Returns -(g + q) x, the square of x over its
  // deviations.
  double solve(const double* diagonal, const double* below, const double* q, double tolerance, int max_iterations,
               double* x, double* inverse_diagonal, double* inverse_below, int num_threads) const;

 private:
  struct Input;  // what the constructor is given, and what it finds on its way

  void find_clusters(Input& input);
  void find_scale(const Input& input, int num_threads);
  void eliminate_planes(Input& input, int num_threads);
  void eliminate_plane(Input& input, std::int64_t plane);
  void sum_scans(const Input& input, int num_threads);
  void apply(const double* diagonal, const double* below, const double* x, double* y, int num_threads) const;
  void subtract_planes(BlockBand& band, int num_threads) const;

  std::int64_t num_scans_, width_;
  double scale_ = 1;
  std::int64_t num_used_ = 0;
  std::vector<double> weights_;
  std::vector<double> diagonal_;  // (scans, 6, 6), sums of w J J^T
  std::vector<double> gradient_;  // (scans, 6), of all
  // Clusters: the returns of one scan on one plane, plane by plane, scans ascending.
  std::vector<std::int64_t> first_of_plane_;  // (planes + 1)
  std::vector<std::int32_t> plane_of_cluster_, scan_of_cluster_;
  std::vector<double> coupling_;             // (clusters, 3, 6), C: H of a plane's clusters s, t is -C_s^T C_t
  std::vector<double> band_coupling_;        // likewise of groups of scans_together scans; empty: the same
  std::vector<std::int32_t> group_end_;      // (clusters), 1 + the last cluster of each one's group
  std::vector<std::int32_t> order_;          // clusters, scan by scan
  std::vector<std::int64_t> first_of_scan_;  // (scans + 1), in `order_`
};

}  // namespace radarsdf
