// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/stl.h>

#include <array>
#include <memory>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "poses/common_planes.hpp"

namespace radarsdf {
namespace {

void check_blocks(const Array<double>& blocks, std::int64_t count, const char* name) {
  if (blocks.ndim() != 3 || blocks.shape(0) != count || blocks.shape(1) != kPose || blocks.shape(2) != kPose) {
    throw std::invalid_argument(std::string(name) + " must have shape (" + std::to_string(count) + ", 6, 6)");
  }
}

}  // namespace

void bind_poses(py::module_& m) {
  using namespace py::literals;
  py::class_<CommonPlanes>(m, "CommonPlanes", "What returns of different scans on common planes say of their poses.")
      .def(py::init([](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
                       const Array<std::int32_t>& scans, const Array<std::int32_t>& planes,
                       const Array<double>& positions, const Array<double>& up_of_scan, const Array<double>& centres,
                       const Array<double>& normals, double extent_m, const std::array<double, 3>& variances,
                       std::int64_t scans_together, int num_threads) {
             const std::int64_t count = check_points(points);
             check_shape(directions, count, 3, "directions");
             if (check_column(ranges_m, "ranges_m") != count || check_column(scans, "scans") != count ||
                 check_column(planes, "planes") != count) {
               throw std::invalid_argument("ranges_m, scans and planes must be one a return");
             }
             const std::int64_t num_scans = check_points(positions);
             check_shape(up_of_scan, num_scans, 3, "up_of_scan");
             const std::int64_t num_planes = check_points(centres);
             check_shape(normals, num_planes, 3, "normals");
             const PosedReturns returns{points.data(),    directions.data(), ranges_m.data(),
                                        scans.data(),     planes.data(),     count,
                                        positions.data(), up_of_scan.data(), num_scans};
             for (std::int64_t i = 0; i < count; ++i) {
               if (returns.planes[i] < -1 || returns.planes[i] >= num_planes) {
                 throw std::invalid_argument("planes must lie in [-1, P)");
               }
               if (returns.scans[i] < (i > 0 ? returns.scans[i - 1] : 0) || returns.scans[i] >= num_scans) {
                 throw std::invalid_argument("scans must ascend in [0, F)");
               }
             }
             if (!(extent_m > 0) || scans_together < 1) {
               throw std::invalid_argument("extent_m and scans_together must be positive");
             }
             const PlanesOfScans of_scans{centres.data(), normals.data(), num_planes, extent_m};
             const ReturnVariances noise{variances[0], variances[1], variances[2]};
             const py::gil_scoped_release release;
             return std::make_unique<CommonPlanes>(returns, of_scans, noise, scans_together, num_threads);
           }),
           "points"_a.noconvert(), "directions"_a.noconvert(), "ranges_m"_a.noconvert(), "scans"_a.noconvert(),
           "planes"_a.noconvert(), "positions"_a.noconvert(), "up_of_scan"_a.noconvert(), "centres"_a.noconvert(),
           "normals"_a.noconvert(), "extent_m"_a, "variances"_a, "scans_together"_a, "num_threads"_a = 0,
           "Returns (N, 3) and directions (N, 3) float32, local frame, m; `ranges_m` (N,) float32; `scans` (N,) int32, "
           "ascending; `planes` (N,) int32, -1: none. `positions` and `up_of_scan` (F, 3), `centres` and `normals` "
           "(P, 3) float64. `extent_m` of a plane; `variances` along the beam, m^2, in azimuth and elevation, rad^2.")
      .def_property_readonly("scale", &CommonPlanes::scale,
                             "Median of squared residuals over their variances, over that of noise; at least 1.")
      .def_property_readonly("num_used", &CommonPlanes::num_used, "Number of returns on planes of several scans.")
      .def_property_readonly(
          "weights", [](const CommonPlanes& planes) { return to_array(std::vector<double>(planes.weights())); },
          "(F,) float64, sum of the weights of the returns of each scan, each at most 1.")
      .def(
          "solve",
          [](const CommonPlanes& planes, const Array<double>& diagonal, const Array<double>& below,
             const Array<double>& gradient, double tolerance, int max_iterations, bool with_inverse, int num_threads) {
            const std::int64_t count = diagonal.ndim() == 3 ? diagonal.shape(0) : 0;
            if (count != static_cast<std::int64_t>(planes.weights().size())) {
              throw std::invalid_argument("diagonal must be one block a scan");
            }
            check_blocks(diagonal, count, "diagonal");
            check_blocks(below, count - 1, "below");
            check_shape(gradient, count, kPose, "gradient");
            py::array_t<double> x({static_cast<py::ssize_t>(count), py::ssize_t{kPose}});
            const auto blocks = [](std::int64_t n) {
              return py::array_t<double>({static_cast<py::ssize_t>(n), py::ssize_t{kPose}, py::ssize_t{kPose}});
            };
            py::array_t<double> inverse = blocks(with_inverse ? count : 0),
                                inverse_below = blocks(with_inverse ? count - 1 : 0);
            const double *d = diagonal.data(), *b = below.data(), *g = gradient.data();
            double *result = x.mutable_data(), *id = with_inverse ? inverse.mutable_data() : nullptr,
                   *ib = with_inverse ? inverse_below.mutable_data() : nullptr;
            double decrement = 0;
            {
              const py::gil_scoped_release release;
              decrement = planes.solve(d, b, g, tolerance, max_iterations, result, id, ib, num_threads);
            }
            return py::make_tuple(x, inverse, inverse_below, decrement);
          },
          "diagonal"_a.noconvert(), "below"_a.noconvert(), "gradient"_a.noconvert(), "tolerance"_a, "max_iterations"_a,
          "with_inverse"_a, "num_threads"_a = 0,
          "Increments (F, 6) of the poses: translation, rotation vector, from the left about the sensor; blocks of the "
          "inverse on and below the diagonal, (F, 6, 6) and (F - 1, 6, 6), if wanted; the square of the increments "
          "over their deviations. The prior "
          "is block tridiagonal: `diagonal` (F, 6, 6), `below` (F - 1, 6, 6), `gradient` (F, 6), all float64.");
}

}  // namespace radarsdf
