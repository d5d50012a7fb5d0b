#include <pybind11/stl.h>

#include <algorithm>
#include <memory>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "poses/common_planes.hpp"
#include "poses/local_planes.hpp"
#include "returns/return_noise.hpp"

namespace radarsdf {
namespace {

void bind_local_planes(py::module_& m) {
  using namespace py::literals;
  py::class_<LocalPlanes>(m, "LocalPlanes", "The planes of scans, each in the cells of a lattice.")
      .def(py::init<double>(), "cell_size_m"_a)
      .def_property_readonly("num_cells", &LocalPlanes::num_cells, "Number of cells with returns.")
      .def(
          "add",
          [](LocalPlanes& planes, const Array<double>& points, int sign) {
            if (sign != 1 && sign != -1) throw std::invalid_argument("sign must be 1 or -1");
            planes.add(points.data(), check_points(points), sign);
          },
          "points"_array, "sign"_a = 1, "Adds points (N, 3) float64, world frame, m; sign -1 removes them exactly.")
      .def(
          "agreement",
          [](const LocalPlanes& planes, const Array<double>& points, const Array<double>& pose,
             const VarianceNumbers& variances) {
            const std::int64_t count = check_points(points);
            check_shape(pose, {4, 4}, "pose");
            const Agreement found = planes.agreement(points.data(), count, pose.data(), variances_of(variances));
            py::array_t<double> hessian({kPose, kPose}), gradient(kPose), doubt({kPose, kPose});
            std::copy(found.doubt.begin(), found.doubt.end(), doubt.mutable_data());
            std::copy(found.hessian.begin(), found.hessian.end(), hessian.mutable_data());
            std::copy(found.gradient.begin(), found.gradient.end(), gradient.mutable_data());
            return py::make_tuple(hessian, gradient, doubt, found.weight);
          },
          "points"_array, "pose"_array, "variances"_a,
          "Normal equations of points (N, 3) float64, sensor frame, m, at `pose` (4, 4): Hessian (6, 6) and gradient "
          "(6,) of half the sum of squared normalised residuals, by increments of the pose as in CommonPlanes; the "
          "part of the Hessian (6, 6) caused by errors of normals; the sum of weights.")
      .def(
          "scores",
          [](const LocalPlanes& planes, const Array<double>& points, const Array<double>& poses,
             const VarianceNumbers& variances, int num_threads) {
            const std::int64_t count = check_points(points);
            const std::int64_t num_poses = poses.ndim() == 3 ? poses.shape(0) : 0;
            check_shape(poses, {num_poses, 4, 4}, "poses");
            Array<double> scores = new_array<double>(num_poses, count);
            planes.scores(points.data(), count, poses.data(), num_poses, variances_of(variances), scores.mutable_data(),
                          num_threads);
            return scores;
          },
          "points"_array, "poses"_array, "variances"_a, "num_threads"_a = 1,
          "Scores 1 / (1 + r² / 4), (K, N) float64, for poses (K, 4, 4) and points (N, 3), sensor frame, m, with the "
          "residual r from a plane in standard deviations; 0 for points without a plane.");
}

}  // namespace

void bind_poses(py::module_& m) {
  using namespace py::literals;
  bind_local_planes(m);
  py::class_<CommonPlanes>(m, "CommonPlanes", "Normal equations of poses from returns of scans on common planes.")
      .def(py::init([](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
                       const Array<std::int32_t>& scans, const Array<std::int32_t>& planes,
                       const Array<double>& positions, const Array<double>& up_of_scan, const Array<double>& centres,
                       const Array<double>& normals, double extent_m, const Array<double>& noise,
                       std::int64_t scans_together, int num_threads) {
             const std::int64_t count = check_rays(points, directions, ranges_m);
             const std::int64_t num_scans = check_points(positions, "positions");
             const std::int64_t num_planes = check_points(centres, "centres");
             check_shape(scans, {count}, "scans");
             check_shape(planes, {count}, "planes");
             check_shape(up_of_scan, {num_scans, 3}, "up_of_scan");
             check_shape(normals, {num_planes, 3}, "normals");
             check_shape(noise, {num_scans, 3}, "noise");
             check_numbers(planes, -1, num_planes, "planes");
             check_numbers(scans, 0, num_scans, "scans");
             if (!std::is_sorted(scans.data(), scans.data() + count)) throw std::invalid_argument("scans must ascend");
             const PosedReturns returns{
                 points.data(), directions.data(), ranges_m.data(),   scans.data(), planes.data(),
                 count,         positions.data(),  up_of_scan.data(), noise.data(), num_scans};
             if (!(extent_m > 0) || scans_together < 1) {
               throw std::invalid_argument("extent_m and scans_together must be positive");
             }
             const PlanesOfScans of_scans{centres.data(), normals.data(), num_planes, extent_m};
             const py::gil_scoped_release release;
             return std::make_unique<CommonPlanes>(returns, of_scans, scans_together, num_threads);
           }),
           "points"_array, "directions"_array, "ranges_m"_array, "scans"_array, "planes"_array, "positions"_array,
           "up_of_scan"_array, "centres"_array, "normals"_array, "extent_m"_a, "noise"_array, "scans_together"_a,
           "num_threads"_a = 0,
           "Points (N, 3) and directions (N, 3) float32, local frame, m; `ranges_m` (N,) float32; `scans` (N,) int32, "
           "ascending; `planes` (N,) int32, -1 for none. `positions` and `up_of_scan` (F, 3), `centres` and `normals` "
           "(P, 3) float64. `extent_m` of a plane; `noise` (F, 3) float64: variances along the beam, m^2, in azimuth "
           "and elevation, rad^2.")
      .def_property_readonly("scale", &CommonPlanes::scale,
                             "Median squared normalised residual, relative to that of Gaussian noise; at least 1.")
      .def_property_readonly(
          "weights", [](const CommonPlanes& planes) { return to_array(std::vector<double>(planes.weights())); },
          "Sums of the weights, each at most 1, of the returns of each scan: (F,) float64.")
      .def_property_readonly(
          "equations",
          [](const CommonPlanes& planes) {
            return py::make_tuple(to_array(std::vector<double>(planes.diagonal())),
                                  to_array(std::vector<double>(planes.gradient())),
                                  to_array(std::vector<double>(planes.coupling())),
                                  to_array(std::vector<std::int32_t>(planes.scan_of_cluster())),
                                  to_array(std::vector<std::int64_t>(planes.first_of_plane())));
          },
          "Matrix and vector of the normal equations, flat: diagonal blocks (F, 6, 6), gradient (F, 6), and blocks (C, "
          "3, "
          "6) of a matrix whose square is subtracted, with the scan (C,) of each and the first (P + 1,) of each plane.")
      .def(
          "solve",
          [](const CommonPlanes& planes, const Array<double>& prior, const Array<double>& gradient, double tolerance,
             int max_iterations, bool with_inverse, int num_threads) {
            const auto count = static_cast<std::int64_t>(planes.weights().size());
            const std::int64_t blocks = prior.ndim() == 4 ? std::clamp<std::int64_t>(prior.shape(1), 1, count) : 1;
            check_shape(prior, {count, blocks, kPose, kPose}, "prior");
            check_shape(gradient, {count, kPose}, "gradient");
            Array<double> x = new_array<double>(count, kPose);
            Array<double> inverse = new_array<double>(with_inverse ? count : 0, kPose, kPose),
                          inverse_below = new_array<double>(with_inverse ? count - 1 : 0, kPose, kPose);
            double *id = with_inverse ? inverse.mutable_data() : nullptr,
                   *ib = with_inverse ? inverse_below.mutable_data() : nullptr;
            const double decrement = without_gil([&] {
              return planes.solve(BlockBand(count, blocks - 1, prior.data()), gradient.data(), tolerance,
                                  max_iterations, x.mutable_data(), id, ib, num_threads);
            });
            return py::make_tuple(x, inverse, inverse_below, decrement);
          },
          "prior"_array, "gradient"_array, "tolerance"_a, "max_iterations"_a, "with_inverse"_a, "num_threads"_a = 0,
          "Increments (F, 6) of the poses: translation, and rotation vector applied from the left about the sensor; "
          "blocks of the inverse on and below the diagonal, (F, 6, 6) and (F - 1, 6, 6), `with_inverse`; squared "
          "Mahalanobis norm of the increments. `prior` (F, W, 6, 6): of each row of its band, the blocks up to the "
          "diagonal; `gradient` (F, 6) of the prior.");
}

}  // namespace radarsdf
