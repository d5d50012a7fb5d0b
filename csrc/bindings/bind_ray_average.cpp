#include <algorithm>
#include <cmath>
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
         const Array<float>& weights, double truncation_m, int num_threads, std::uint32_t weight_of_return) {
        const std::int64_t count = check_points(points);
        check_shape(directions, {count, 3}, "directions");
        check_shape(normals, {count, 3}, "normals");
        check_shape(weights, {count}, "weights");
        const auto is_count = [](float w) { return w >= 0 && w < 0x1p32F && w == std::floor(w); };
        if (!std::all_of(weights.data(), weights.data() + count, is_count)) {
          throw std::invalid_argument("weights must be integers of at least 0");
        }
        Array<float> distances = new_array<float>(t.num_rows());
        Array<std::int8_t> sides = new_array<std::int8_t>(t.num_rows());
        const AveragedRays rays{points.data(), directions.data(), normals.data(), weights.data(),
                                count,         weight_of_return};
        without_gil(
            [&] { average_rays(t, rays, truncation_m, distances.mutable_data(), sides.mutable_data(), num_threads); });
        return std::pair(distances, sides);
      },
      "points"_array, "directions"_array, "normals"_array, "weights"_array, "truncation_m"_a, "num_threads"_a = 0,
      "weight_of_return"_a = 1,
      "For an octree, mean signed distance of each vertex, (num_rows,) float32, m, to planes through `points` (N, 3) "
      "with `normals` (N, 3). The mean is over rays along `directions` (N, 3) that cross leaf cells of the vertex "
      "within `truncation_m` of their points, one term per cell; all float32, local frame. `weights` (N,) are "
      "integers. Also the sides of the "
      "vertices, (num_rows,) int8: 1 if many rays passed it, -1 if it lies in unobserved space behind many returns, "
      "else 0.");
  table.attr("SMOOTHING_REACH") = kSmoothingReach;
  table.def(
      "smoothed",
      [](const VertexTable& t, const Array<float>& distances_m, const Array<float>& points, const Array<float>& normals,
         const Array<float>& information, const Array<std::int8_t>& sides, int iterations, int num_threads) {
        const std::int64_t count = check_points(points);
        check_shape(normals, {count, 3}, "normals");
        check_shape(information, {count}, "information");
        check_shape(distances_m, {t.num_rows()}, "distances_m");
        check_shape(sides, {t.num_rows()}, "sides");
        Array<float> result = new_array<float>(t.num_rows());
        std::copy_n(distances_m.data(), distances_m.size(), result.mutable_data());
        const KnownPlanes planes{points.data(), normals.data(), information.data(), count};
        without_gil([&] { smooth_distances(t, planes, sides.data(), iterations, result.mutable_data(), num_threads); });
        return result;
      },
      "distances_m"_array, "points"_array, "normals"_array, "information"_array, "sides"_array, "iterations"_a,
      "num_threads"_a = 0,
      "For an octree, smooths `distances_m` (num_rows,) float32 by `iterations` steps towards the minimum of squared "
      "residuals from planes through `points` (N, 3) with `normals` (N, 3) and `information` (N,), m^-2, all float32, "
      "local frame, plus bending energy. Vertices stay on the `sides` (num_rows,) int8 of `average_rays`. An iteration "
      "propagates information by SMOOTHING_REACH vertices.");
}

}  // namespace radarsdf
