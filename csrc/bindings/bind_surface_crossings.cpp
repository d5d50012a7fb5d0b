// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <memory>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/surface_crossings.hpp"

namespace radarsdf {
namespace {

constexpr int kSurfelFloats = sizeof(Surfel) / sizeof(float);
static_assert(kSurfelFloats == 7, "a surfel is a row of seven floats");

}  // namespace

void bind_surface_crossings(py::module_& m) {
  using namespace py::literals;
  py::class_<SurfelMap>(m, "SurfelMap", "Pieces of plane in cells, and the rays that pass through them.")
      .def(py::init([](const Array<std::uint64_t>& keys, const Array<float>& surfels, double cell_size_m) {
             if (keys.ndim() != 1) throw std::invalid_argument("keys must have shape (M,)");
             check_shape(surfels, keys.shape(0), kSurfelFloats, "surfels");
             return std::make_unique<SurfelMap>(keys.data(), reinterpret_cast<const Surfel*>(surfels.data()),
                                                keys.shape(0), cell_size_m);
           }),
           "keys"_a.noconvert(), "surfels"_a.noconvert(), "cell_size_m"_a,
           "`keys` (M,) uint64 of `cell_keys`, each once; `surfels` (M, 7) float32: centre, normal towards the "
           "sensors, standard deviation of the returns across the plane; local frame, m.")
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
          "For each ray the first surfel that it crosses from the front and ends behind of by more than `margin_m` "
          "and `sigmas` standard deviations, -1 where there is none: (N,) int32.");
}

}  // namespace radarsdf
