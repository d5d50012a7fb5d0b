#include <optional>

#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "bindings/table_arrays.hpp"
#include "field/encodings.hpp"

namespace radarsdf {
namespace {

// Calls `by` with the checked batch, the gradient and its stride, and the sums, without the GIL.
template <typename T, typename By>
void scatter_by(const VertexTable& table, const Array<T>& points, const Array<std::int32_t>& located,
                const std::optional<Array<T>>& directions, const Rows<T>& out_grad, Array<T>& features_grad,
                const By& by) {
  const PointBatch<T> batch = point_batch(table, points, located, directions);
  check_shape(features_grad, {table.num_rows(), kFeatureDim}, "features_grad");
  const std::int64_t stride = row_stride(out_grad, batch.count, table.num_levels() * kFeatureDim, "out_grad");
  const py::gil_scoped_release release;
  by(batch, out_grad.data(), stride, features_grad.mutable_data());
}

template <typename T>
void bind_kernels(py::class_<VertexTable>& cls) {
  using Located = Array<std::int32_t>;
  using Directions = std::optional<Array<T>>;
  using namespace py::literals;

  cls.def(
      "locate",
      [](const VertexTable& table, const Array<T>& points, Located& located, int num_threads) {
        const std::int64_t count = check_points(points);
        check_shape(located, {count, table.num_levels()}, "located");
        const py::gil_scoped_release release;
        locate(table, points.data(), count, located.mutable_data(), num_threads);
      },
      "points"_array, "located"_array, "num_threads"_a = 0,
      "Writes the cell of each point (N, 3), local frame, m, at each level, or -1, to `located` (N, L) int32.");

  cls.def(
      "encode",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, Located& located, Rows<T>& out,
         int num_threads) {
        const std::int64_t count = check_points(points);
        check_shape(features, {table.num_rows(), kFeatureDim}, "features");
        check_shape(located, {count, table.num_levels()}, "located");
        const std::int64_t stride = row_stride(out, count, table.num_levels() * kFeatureDim, "out");
        const py::gil_scoped_release release;
        encode(table, features.data(), points.data(), count, located.mutable_data(), out.mutable_data(), stride,
               num_threads);
      },
      "features"_array, "points"_array, "located"_array, "out"_array, "num_threads"_a = 0,
      "Locates points and writes their interpolated features to `out` (N, 8 L).");

  cls.def(
      "interpolate",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, const Located& located,
         const Directions& directions, Rows<T>& out, int num_threads) {
        const PointBatch<T> batch = point_batch(table, points, located, directions);
        check_shape(features, {table.num_rows(), kFeatureDim}, "features");
        const std::int64_t stride = row_stride(out, batch.count, table.num_levels() * kFeatureDim, "out");
        const py::gil_scoped_release release;
        interpolate(table, features.data(), batch, out.mutable_data(), stride, num_threads);
      },
      "features"_array, "points"_array, "located"_array, "directions"_array.none(true), "out"_array,
      "num_threads"_a = 0,
      "Like `encode` for located points; with `directions` (N, 3), the directional derivative of the features.");

  cls.def(
      "scatter",
      [](const VertexTable& table, const Array<T>& points, const Located& located, const Directions& directions,
         const Rows<T>& out_grad, Array<T>& features_grad, int num_threads) {
        scatter_by(table, points, located, directions, out_grad, features_grad,
                   [&](const auto&... arguments) { scatter(table, arguments..., num_threads); });
      },
      "points"_array, "located"_array, "directions"_array.none(true), "out_grad"_array, "features_grad"_array,
      "num_threads"_a = 0,
      "Adds the transpose of `interpolate`, applied to `out_grad` (N, 8 L), to `features_grad` (num_rows, 8).");

  cls.def(
      "scatter",
      [](const VertexTable& table, const Array<T>& points, const Located& located, const Rows<T>& out_grad,
         Array<T>& features_grad, HeldThreadPool& pool) {
        scatter_by(table, points, located, Directions(), out_grad, features_grad, [&](const auto&... arguments) {
          pool.pool().run(num_level_tasks(table),
                          [&](std::int64_t task) { scatter_task(table, arguments..., level_task(table, task)); });
        });
      },
      "points"_array, "located"_array, "out_grad"_array, "features_grad"_array, "pool"_a,
      "Like `scatter`, on the threads of a thread pool, without directions.");

  cls.def(
      "coordinate_gradient",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, const Located& located,
         const Directions& directions, const Rows<T>& out_grad, Array<T>& points_grad, int num_threads) {
        const PointBatch<T> batch = point_batch(table, points, located, directions);
        check_shape(features, {table.num_rows(), kFeatureDim}, "features");
        check_shape(points_grad, {batch.count, 3}, "points_grad");
        const std::int64_t stride = row_stride(out_grad, batch.count, table.num_levels() * kFeatureDim, "out_grad");
        const py::gil_scoped_release release;
        coordinate_gradient(table, features.data(), batch, out_grad.data(), stride, points_grad.mutable_data(),
                            num_threads);
      },
      "features"_array, "points"_array, "located"_array, "directions"_array.none(true), "out_grad"_array,
      "points_grad"_array, "num_threads"_a = 0,
      "Writes the gradient of (interpolate . out_grad) by the points to `points_grad` (N, 3), 1/m.");
}

}  // namespace

void bind_interpolation(VertexTableClass& table) {
  using namespace py::literals;
  table.def(
      "into_cells",
      [](const VertexTable& t, Array<float>& points, float step_m, int num_threads) {
        const std::int64_t count = check_points(points);
        Array<bool> inside = new_array<bool>(count);
        without_gil([&] { into_cells(t, points.mutable_data(), count, step_m, inside.mutable_data(), num_threads); });
        return inside;
      },
      "points"_array, "step_m"_a, "num_threads"_a = 0,
      "Moves `points` (N, 3) float32 within `step_m` of a face into an adjacent leaf cell, and returns whether they "
      "are in one (N,).");
  table.def(
      "trilinear",
      [](const VertexTable& t, const Array<float>& values, const Array<float>& points, int num_threads) {
        const std::int64_t count = check_points(points);
        if (t.encoding() != Encoding::kOctree || t.num_levels() != 1 || check_column(values, "values") != t.num_rows())
          throw std::invalid_argument("values must be one for each row of an octree of one level");
        Array<float> out = new_array<float>(count, 4);
        without_gil([&] { trilinear(t, values.data(), points.data(), count, out.mutable_data(), num_threads); });
        return out;
      },
      "values"_array, "points"_array, "num_threads"_a = 0,
      "Interpolation of `values` (num_rows,) float32, and its gradient, (N, 4); 0 outside the cells.");
  bind_kernels<float>(table);
  bind_kernels<double>(table);
}

}  // namespace radarsdf
