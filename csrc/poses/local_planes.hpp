// Planes of previous scans, with which a scan is registered.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "lattice/flat_map.hpp"
#include "poses/block_band.hpp"
#include "returns/return_noise.hpp"

namespace radarsdf {

// Agreement of returns with planes, as a function of the pose of their sensor.
struct Agreement {
  std::array<double, kBlock> hessian{};  // of half the sum of squares, by increments of CommonPlanes
  std::array<double, kPose> gradient{};
  // Contribution of errors of the normals to the Hessian: along a wall, normals are slightly tilted by chance. If it is
  // all of the Hessian, the returns have no information.
  std::array<double, kBlock> doubt{};
  double weight = 0;  // sum over the returns, each at most 1
};

// Scans are added and removed exactly, with integer sums over their returns. A cell's plane is fitted to the returns in
// it and its 26 neighbours.
class LocalPlanes {
 public:
  explicit LocalPlanes(double cell_size_m);

  // points: (count, 3), world frame, m. sign: 1 adds them, -1 removes them. Throws std::invalid_argument, without any
  // change, if a point is too far away, or was never added.
  void add(const double* points, std::int64_t count, int sign);

  std::int64_t num_cells() const { return static_cast<std::int64_t>(cells_.size()); }

  // points: (count, 3), sensor frame, m; pose: (4, 4) T_world_sensor. The variance of a residual is the sum of that of
  // the return and that of the plane at its position; weights are Geman-McClure.
  Agreement agreement(const double* points, std::int64_t count, const double* pose, const ReturnVariances& noise) const;

  // scores: (num_poses, count), 1 / (1 + r^2 / (4 variance)) for each pose (num_poses, 4, 4) and return; 0 for a return
  // without a plane.
  void scores(const double* points, std::int64_t count, const double* poses, std::int64_t num_poses,
              const ReturnVariances& noise, double* scores, int num_threads) const;

 private:
  static constexpr int kMoments = 10;  // 1, x, y, z, xx, xy, xz, yy, yz, zz, in quanta from the corner of the cell
  using Moments = std::array<std::int64_t, kMoments>;
  struct Plane {
    Vec3 centre, axes[3];  // the normal, and in the plane, each as long as the standard deviation of its slope
    double variance;       // at the centre, m^2
  };
  struct Known {
    FlatMap rows;  // of `planes`
    std::vector<Plane> planes;
  };
  struct Residual {
    double value, variance;
    std::int32_t plane;
  };

  std::optional<std::uint64_t> key(const Vec3& point) const;
  std::optional<Plane> plane_of(std::uint64_t key) const;  // if it is flat
  std::optional<Residual> residual(const Beam& beam, const double* pose, const ReturnVariances&, Known&) const;

  double cell_size_m_, cells_per_m_;
  FlatMap cells_;  // rows of sums_
  std::vector<Moments> sums_;
  std::vector<std::int32_t> free_;       // rows of sums_ without a cell
  mutable std::vector<Known> known_{1};  // of each thread, caches that are cleared when scans change
};

}  // namespace radarsdf
