// Bundle adjustment with planes eliminated: normal equations of the poses of scans, from returns on common planes.
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
  const std::int32_t* planes;  ///< (count), the plane of each return; -1: none
  std::int64_t count;
  const double* positions;      ///< (scans, 3), of the sensor
  const double* up_of_scan;     ///< (scans, 3), the z axis of the sensor
  const double* noise_of_scan;  ///< (scans, 3), variances along the beam, m^2, in azimuth and elevation, rad^2
  std::int64_t num_scans;
};

struct PlanesOfScans {
  const double* centres;  ///< (count, 3), local frame, m
  const double* normals;  ///< (count, 3), unit
  std::int64_t count;
  double extent_m;  ///< lever arm of the tilts of a plane
};

// The residual of a return is its distance from its plane, n (x - c) - (offset + tilts of the plane), over the standard
// deviation of its noise along n, with Geman-McClure weights. A plane's offset and two tilts are unknowns, too, and are
// eliminated (Schur complement), which leaves constraints between the poses of its scans. Planes seen by a single scan
// have no information. The pose unknowns are left increments about the position of the sensor: a translation, and a
// rotation vector, in the local frame.
class CommonPlanes {
 public:
  // In the factored band of the matrix, a plane couples at most `scans_together` neighbouring scans.
  CommonPlanes(const PosedReturns& returns, const PlanesOfScans& planes, std::int64_t scans_together, int num_threads);

  // Ratio of the median of the normalised squared residuals to that of a normal distribution, at least 1. It scales all
  // variances, since wrong poses inflate residuals.
  double scale() const { return scale_; }
  const std::vector<double>& weights() const { return weights_; }  // (scans), sums over returns, each in [0, 1]
  // H is block diagonal, less C^T C with the blocks `coupling` of `scan_of_cluster` in the three rows of each plane.
  const std::vector<double>& diagonal() const { return diagonal_; }
  const std::vector<double>& gradient() const { return gradient_; }
  const std::vector<double>& coupling() const { return coupling_; }
  const std::vector<std::int32_t>& scan_of_cluster() const { return scan_of_cluster_; }
  const std::vector<std::int64_t>& first_of_plane() const { return first_of_plane_; }

  // Solves (H + P) x = -(g + q) for the increments x (scans, 6): H and g are of the planes, P and q (scans, 6) of the
  // prior. By conjugate gradients, preconditioned by a band Cholesky factor, which is exact unless distant scans share
  // a plane. If given, `inverse_diagonal` (scans, 6, 6) and `inverse_below` (scans - 1, 6, 6) receive blocks of the
  // inverse of that band, an upper bound of the covariance. Returns -(g + q) x, squared standard deviations of x.
  double solve(const BlockBand& prior, const double* q, double tolerance, int max_iterations, double* x,
               double* inverse_diagonal, double* inverse_below, int num_threads) const;

 private:
  struct Input;  // arguments and intermediate results of the constructor

  void find_clusters(Input& input);
  void find_scale(const Input& input, int num_threads);
  void eliminate_planes(Input& input, int num_threads);
  void eliminate_plane(Input& input, std::int64_t plane);
  void sum_scans(const Input& input, int num_threads);
  void apply(const BlockBand& prior, const double* x, double* y, int num_threads) const;
  void subtract_planes(BlockBand& band, int num_threads) const;

  std::int64_t num_scans_, width_;
  double scale_ = 1;
  std::vector<double> weights_;
  std::vector<double> diagonal_;  // (scans, 6, 6), sums of w J J^T
  std::vector<double> gradient_;  // (scans, 6), total
  // Clusters: the returns of one scan on one plane, ordered by plane, then scan.
  std::vector<std::int64_t> first_of_plane_;  // (planes + 1)
  std::vector<std::int32_t> plane_of_cluster_, scan_of_cluster_;
  std::vector<double> coupling_;             // (clusters, 3, 6), C: H of a plane's clusters s, t is -C_s^T C_t
  std::vector<double> band_coupling_;        // the same for groups of scans_together scans; empty: identical
  std::vector<std::int32_t> group_end_;      // (clusters), 1 + the last cluster of each one's group
  std::vector<std::int32_t> order_;          // clusters by scan
  std::vector<std::int64_t> first_of_scan_;  // (scans + 1), in `order_`
};

}  // namespace radarsdf
