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
             const py::gil_scoped_release release;
             return std::make_unique<SurfaceTracer>(vertices.data(), num_vertices, faces.data(), num_faces,
                                                    num_threads);
           }),
           "vertices"_array, "faces"_array, "num_threads"_a = 0,
           "`vertices` (V, 3) float64, local frame, m; `faces` (F, 3) int32.")
      .def_property_readonly("nbytes", &SurfaceTracer::num_bytes)
      .def(
          "first_hits",
          [](const SurfaceTracer& tracer, const std::array<double, 3>& origin, const Array<float>& directions,
             double max_range_m, bool front_only, int num_threads) -> Hits {
            const std::int64_t count = check_points(directions);
            Array<float> ranges_m = new_array<float>(count);
            Array<std::int32_t> faces = new_array<std::int32_t>(count);
            without_gil([&] {
              tracer.first_hits(origin.data(), directions.data(), count, max_range_m, front_only,
                                ranges_m.mutable_data(), faces.mutable_data(), num_threads);
            });
            return py::make_tuple(std::move(ranges_m), std::move(faces));
          },
          "origin"_a, "directions"_array, "max_range_m"_a, "front_only"_a = false, "num_threads"_a = 0,
          "Range of the first hit along each ray (N,) float32, m, infinite without a hit, and row of the triangle in "
          "`faces` (N,) int32, -1 without a hit. `origin` (3,), local frame, m; `directions` (N, 3) float32 unit "
          "vectors. `front_only`: back faces are culled.");
}

}  // namespace radarsdf
