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
             const std::int64_t count = check_column(keys, "keys");
             check_shape(surfels, {count, kSurfelFloats}, "surfels");
             return std::make_unique<SurfelMap>(keys.data(), reinterpret_cast<const Surfel*>(surfels.data()), count,
                                                cell_size_m);
           }),
           "keys"_array, "surfels"_array, "cell_size_m"_a,
           "`keys` (M,) uint64 of `cell_keys`, unique; `surfels` (M, 8) float32: centre, normal towards the sensors, "
           "standard deviation of the returns along the normal, maximum distance of crossings from the centre, inf for "
           "all of the cell; local frame, m.")
      .def(
          "first_crossings",
          [](const SurfelMap& map, const Array<float>& points, const Array<float>& directions,
             const Array<float>& ranges_m, float sigma_range_m, float sigma_angle_rad, float margin_m, float sigmas,
             int num_threads) {
            const std::int64_t count = check_rays(points, directions, ranges_m);
            Array<std::int32_t> crossed = new_array<std::int32_t>(count);
            without_gil([&] {
              map.first_crossings(points.data(), directions.data(), ranges_m.data(), count,
                                  {sigma_range_m, sigma_angle_rad}, margin_m, sigmas, crossed.mutable_data(),
                                  num_threads);
            });
            return crossed;
          },
          "points"_array, "directions"_array, "ranges_m"_array, "sigma_range_m"_a, "sigma_angle_rad"_a, "margin_m"_a,
          "sigmas"_a, "num_threads"_a = 0,
          "First surfel that each ray crosses from the front and ends behind, by more than `margin_m` plus `sigmas` "
          "standard deviations, or -1: (N,) int32.");
  m.def(
      "move_onto_planes",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
         const Array<std::int32_t>& scans, const Array<double>& up_of_scan, const Array<std::int32_t>& planes,
         const Array<double>& centres, const Array<double>& normals, const Array<double>& variances_m2,
         const Array<double>& noise, const std::optional<Array<bool>>& kept, int num_threads) {
        const std::int64_t count = check_rays(points, directions, ranges_m);
        const std::int64_t num_scans = check_points(up_of_scan, "up_of_scan");
        check_shape(noise, {num_scans, 3}, "noise");
        const std::int64_t num_planes = check_column(variances_m2, "variances_m2");
        check_shape(centres, {num_planes, 3}, "centres");
        check_shape(normals, {num_planes, 3}, "normals");
        if (kept) check_shape(*kept, {count}, "kept");
        check_shape(scans, {count}, "scans");
        check_shape(planes, {count}, "planes");
        check_numbers(scans, 0, num_scans, "scans");
        check_numbers(planes, -1, num_planes, "planes");
        const bool* k = kept ? kept->data() : nullptr;
        const std::int64_t rows = k == nullptr ? count : std::count(k, k + count, true);
        Array<float> new_points = new_array<float>(rows, 3), new_directions = new_array<float>(rows, 3),
                     new_ranges = new_array<float>(rows);
        const NoisyRays rays{points.data(), directions.data(), ranges_m.data(), scans.data(), planes.data(), k,
                             count,         up_of_scan.data(), noise.data()};
        const Planes all{centres.data(), normals.data(), variances_m2.data(), num_planes};
        const MovedRays moved{new_points.mutable_data(), new_directions.mutable_data(), new_ranges.mutable_data()};
        without_gil([&] { move_onto_planes(rays, all, moved, num_threads); });
        return py::make_tuple(new_points, new_directions, new_ranges);
      },
      "points"_array, "directions"_array, "ranges_m"_array, "scans"_array, "up_of_scan"_array, "planes"_array,
      "centres"_array, "normals"_array, "variances_m2"_array, "noise"_array, "kept"_array = py::none(),
      "num_threads"_a = 0,
      "Points, directions and ranges of the `kept` rays, (N,) bool or None for all, with returns shrunk towards their "
      "`planes` (N,) int32, -1 for none, by "
      "the share of their noise. Rays: `points`, `directions` (N, 3), `ranges_m` (N,) float32, `scans` (N,) int32; "
      "`up_of_scan` (F, 3) float64. Planes: `centres`, `normals` (P, 3), `variances_m2` (P,) of their returns, "
      "float64. `noise` (F, 3) float64: variances along the beam, m^2, in azimuth and elevation, rad^2. Local frame, "
      "m.");
}

}  // namespace radarsdf
