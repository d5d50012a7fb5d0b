#include <algorithm>
#include <utility>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/ray_average.hpp"
#include "returns/smooth_distances.hpp"

namespace radarsdf {

void bind_ray_average(VertexTableClass& table) {
  using namespace py::literals;
  table.def(
      "average_rays",
      [](const VertexTable& t, const Array<float>& points, const Array<float>& directions, const Array<float>& normals,
         const Array<float>& weights, double truncation_m, int num_threads) {
        const std::int64_t count = check_points(points);
        check_shape(directions, count, 3, "directions");
        check_shape(normals, count, 3, "normals");
        if (weights.ndim() != 1 || weights.shape(0) != count) {
          throw std::invalid_argument("weights must have shape (N,)");
        }
        Array<float> distances(static_cast<py::ssize_t>(t.num_rows()));
        Array<std::int8_t> sides(static_cast<py::ssize_t>(t.num_rows()));
        float* result = distances.mutable_data();
        std::int8_t* of_vertices = sides.mutable_data();
        const AveragedRays rays{points.data(), directions.data(), normals.data(), weights.data(), count};
        {
          const py::gil_scoped_release release;
          average_rays(t, rays, truncation_m, result, of_vertices, num_threads);
        }
        return std::pair(distances, sides);
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "normals"_a.noconvert(), "weights"_a.noconvert(),
      "truncation_m"_a, "num_threads"_a = 0,
      "For an octree, mean signed distance of each vertex, (num_rows,) float32, m, to planes through `points` (N, 3) "
      "with `normals` (N, 3). The mean is over rays along `directions` (N, 3) that cross leaf cells of the vertex "
      "within `truncation_m` of their points, one term per cell; all float32, local frame. Also the sides of the "
      "vertices, (num_rows,) int8: 1 if many rays passed it, -1 if it lies in unobserved space behind many returns, "
      "else 0.");
  table.attr("SMOOTHING_REACH") = kSmoothingReach;
  table.def(
      "smoothed",
      [](const VertexTable& t, const Array<float>& distances_m, const Array<float>& points, const Array<float>& normals,
         const Array<float>& information, const Array<std::int8_t>& sides, int iterations, int num_threads) {
        const std::int64_t count = check_points(points);
        check_shape(normals, count, 3, "normals");
        if (check_column(information, "information") != count) {
          throw std::invalid_argument("information must have shape (N,)");
        }
        if (check_column(distances_m, "distances_m") != t.num_rows()) {
          throw std::invalid_argument("distances_m must have shape (num_rows,)");
        }
        if (check_column(sides, "sides") != t.num_rows()) {
          throw std::invalid_argument("sides must have shape (num_rows,)");
        }
        Array<float> result(distances_m.size());
        std::copy_n(distances_m.data(), distances_m.size(), result.mutable_data());
        float* moved = result.mutable_data();
        const std::int8_t* of_vertices = sides.data();
        const KnownPlanes planes{points.data(), normals.data(), information.data(), count};
        {
          const py::gil_scoped_release release;
          smooth_distances(t, planes, of_vertices, iterations, moved, num_threads);
        }
        return result;
      },
      "distances_m"_a.noconvert(), "points"_a.noconvert(), "normals"_a.noconvert(), "information"_a.noconvert(),
      "sides"_a.noconvert(), "iterations"_a, "num_threads"_a = 0,
      "For an octree, smooths `distances_m` (num_rows,) float32 by `iterations` steps towards the minimum of squared "
      "residuals from planes through `points` (N, 3) with `normals` (N, 3) and `information` (N,), m^-2, all float32, "
      "local frame, plus bending energy. Vertices stay on the `sides` (num_rows,) int8 of `average_rays`. An iteration "
      "propagates information by SMOOTHING_REACH vertices.");
}

}  // namespace radarsdf
