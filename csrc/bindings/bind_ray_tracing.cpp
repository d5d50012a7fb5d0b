#include <pybind11/stl.h>
#include <pybind11/typing.h>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "surface/ray_tracing.hpp"

namespace radarsdf {

void bind_ray_tracing(py::module_& m) {
  using namespace py::literals;
  using Hits = py::typing::Tuple<py::array_t<float>, py::array_t<std::int32_t>>;
  py::class_<SurfaceTracer>(m, "SurfaceTracer", "First hits of rays on a triangle mesh.")
      .def(py::init([](const Array<double>& vertices, const Array<std::int32_t>& faces, int num_threads) {
             const std::int64_t num_vertices = check_points(vertices), num_faces = check_points(faces);
             const double* v = vertices.data();
             const std::int32_t* f = faces.data();
             const py::gil_scoped_release release;
             return std::make_unique<SurfaceTracer>(v, num_vertices, f, num_faces, num_threads);
           }),
           "vertices"_a.noconvert(), "faces"_a.noconvert(), "num_threads"_a = 0,
           "`vertices` (V, 3) float64, local frame, m; `faces` (F, 3) int32.")
      .def_property_readonly("nbytes", &SurfaceTracer::num_bytes)
      .def(
          "first_hits",
          [](const SurfaceTracer& tracer, const std::array<double, 3>& origin, const Array<float>& directions,
             double max_range_m, bool front_only, int num_threads) -> Hits {
            const std::int64_t count = check_points(directions);
            py::array_t<float> ranges_m(static_cast<py::ssize_t>(count));
            py::array_t<std::int32_t> faces(static_cast<py::ssize_t>(count));
            const float* d = directions.data();
            float* r = ranges_m.mutable_data();
            std::int32_t* f = faces.mutable_data();
            {
              const py::gil_scoped_release release;
              tracer.first_hits(origin.data(), d, count, max_range_m, front_only, r, f, num_threads);
            }
            return py::make_tuple(std::move(ranges_m), std::move(faces));
          },
          "origin"_a, "directions"_a.noconvert(), "max_range_m"_a, "front_only"_a = false, "num_threads"_a = 0,
          "Range of the first hit along each ray (N,) float32, m, infinite without a hit, and row of the triangle in "
          "`faces` (N,) int32, -1 without a hit. `origin` (3,), local frame, m; `directions` (N, 3) float32 unit "
          "vectors. `front_only`: back faces are culled.");
}

}  // namespace radarsdf
