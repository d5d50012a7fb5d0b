#include <pybind11/stl.h>

#include <algorithm>
#include <memory>
#include <optional>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/onto_planes.hpp"
#include "returns/return_noise.hpp"
#include "returns/surface_crossings.hpp"

namespace radarsdf {
namespace {

constexpr int kSurfelFloats = sizeof(Surfel) / sizeof(float);
static_assert(kSurfelFloats == 8, "a surfel is a row of eight floats");

}  // namespace

void bind_surface_crossings(py::module_& m) {
  using namespace py::literals;
  py::class_<SurfelMap>(m, "SurfelMap", "Surfels in cells, and rays that cross them.")
      .def(py::init([](const Array<std::uint64_t>& keys, const Array<float>& surfels, double cell_size_m) {
             if (keys.ndim() != 1) throw std::invalid_argument("keys must have shape (M,)");
             check_shape(surfels, keys.shape(0), kSurfelFloats, "surfels");
             return std::make_unique<SurfelMap>(keys.data(), reinterpret_cast<const Surfel*>(surfels.data()),
                                                keys.shape(0), cell_size_m);
           }),
           "keys"_a.noconvert(), "surfels"_a.noconvert(), "cell_size_m"_a,
           "`keys` (M,) uint64 of `cell_keys`, unique; `surfels` (M, 8) float32: centre, normal towards the sensors, "
           "standard deviation of the returns along the normal, maximum distance of crossings from the centre, inf for "
           "all of the cell; local frame, m.")
      .def(
          "first_crossings",
          [](const SurfelMap& map, const Array<float>& points, const Array<float>& directions,
             const Array<float>& ranges_m, float sigma_range_m, float sigma_angle_rad, float margin_m, float sigmas,
             int num_threads) {
            const std::int64_t count = ranges_m.shape(0);
            if (ranges_m.ndim() != 1) throw std::invalid_argument("ranges_m must have shape (N,)");
            check_shape(points, count, 3, "points");
            check_shape(directions, count, 3, "directions");
            py::array_t<std::int32_t> crossed(static_cast<py::ssize_t>(count));
            std::int32_t* result = crossed.mutable_data();
            const float *p = points.data(), *d = directions.data(), *r = ranges_m.data();
            {
              const py::gil_scoped_release release;
              map.first_crossings(p, d, r, count, {sigma_range_m, sigma_angle_rad}, margin_m, sigmas, result,
                                  num_threads);
            }
            return crossed;
          },
          "points"_a.noconvert(), "directions"_a.noconvert(), "ranges_m"_a.noconvert(), "sigma_range_m"_a,
          "sigma_angle_rad"_a, "margin_m"_a, "sigmas"_a, "num_threads"_a = 0,
          "First surfel that each ray crosses from the front and ends behind, by more than `margin_m` plus `sigmas` "
          "standard deviations, or -1: (N,) int32.");
  m.def(
      "move_onto_planes",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
         const Array<std::int32_t>& scans, const Array<double>& up_of_scan, const Array<std::int32_t>& planes,
         const Array<double>& centres, const Array<double>& normals, const Array<double>& variances_m2,
         const VarianceNumbers& noise, const std::optional<Array<bool>>& kept, int num_threads) {
        const std::int64_t count = check_points(points), num_planes = check_column(variances_m2, "variances_m2");
        check_shape(directions, count, 3, "directions");
        check_shape(up_of_scan, up_of_scan.ndim() == 2 ? up_of_scan.shape(0) : 0, 3, "up_of_scan");
        check_shape(centres, num_planes, 3, "centres");
        check_shape(normals, num_planes, 3, "normals");
        if (check_column(ranges_m, "ranges_m") != count || check_column(scans, "scans") != count ||
            check_column(planes, "planes") != count || (kept && check_column(*kept, "kept") != count)) {
          throw std::invalid_argument("ranges_m, scans, planes and kept must be one for each point");
        }
        const std::int32_t *s = scans.data(), *o = planes.data();
        if (std::any_of(s, s + count, [&](std::int32_t scan) { return scan < 0 || scan >= up_of_scan.shape(0); }) ||
            std::any_of(o, o + count, [&](std::int32_t plane) { return plane < -1 || plane >= num_planes; })) {
          throw std::invalid_argument("scans and planes must be rows of up_of_scan and centres");
        }
        const bool* k = kept ? kept->data() : nullptr;
        const py::ssize_t rows = static_cast<py::ssize_t>(k == nullptr ? count : std::count(k, k + count, true));
        py::array_t<float> new_points({rows, py::ssize_t{3}}), new_directions({rows, py::ssize_t{3}}), new_ranges(rows);
        const NoisyRays rays{points.data(), directions.data(), ranges_m.data(), s, o, k, count, up_of_scan.data()};
        const Planes all{centres.data(), normals.data(), variances_m2.data(), num_planes};
        const MovedRays moved{new_points.mutable_data(), new_directions.mutable_data(), new_ranges.mutable_data()};
        {
          const py::gil_scoped_release release;
          move_onto_planes(rays, all, variances_of(noise), moved, num_threads);
        }
        return py::make_tuple(new_points, new_directions, new_ranges);
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "ranges_m"_a.noconvert(), "scans"_a.noconvert(),
      "up_of_scan"_a.noconvert(), "planes"_a.noconvert(), "centres"_a.noconvert(), "normals"_a.noconvert(),
      "variances_m2"_a.noconvert(), "noise"_a, "kept"_a.noconvert() = py::none(), "num_threads"_a = 0,
      "Points, directions and ranges of the `kept` rays, (N,) bool or None for all, with returns shrunk towards their "
      "`planes` (N,) int32, -1 for none, by "
      "the share of their noise. Rays: `points`, `directions` (N, 3), `ranges_m` (N,) float32, `scans` (N,) int32; "
      "`up_of_scan` (F, 3) float64. Planes: `centres`, `normals` (P, 3), `variances_m2` (P,) of their returns, "
      "float64. `noise`: variances along the beam, m^2, in azimuth and elevation, rad^2. Local frame, m.");
}

}  // namespace radarsdf
