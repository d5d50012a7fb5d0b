// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/ray_average.hpp"

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
        float* result = distances.mutable_data();
        const AveragedRays rays{points.data(), directions.data(), normals.data(), weights.data(), count};
        {
          const py::gil_scoped_release release;
          average_rays(t, rays, truncation_m, result, num_threads);
        }
        return distances;
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "normals"_a.noconvert(), "weights"_a.noconvert(),
      "truncation_m"_a, "num_threads"_a = 0,
      "Of an octree: for each vertex (num_rows,) float32 the mean of its signed distances, m, to planes through "
      "the "
      "`points` (N, 3) with these `normals` (N, 3), over the rays along `directions` (N, 3) that go through one of "
      "its leaf cells within `truncation_m` of their points, each as often as it does; all float32, local frame.");
}

}  // namespace radarsdf
