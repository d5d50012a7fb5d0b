// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/stl.h>

#include <memory>
#include <optional>
#include <tuple>
#include <vector>

#include "bindings/arrays.hpp"
#include "field/encodings.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/vertex_table.hpp"
#include "returns/ray_average.hpp"

namespace radarsdf {
namespace {

// Hands a vector's memory to NumPy without a copy.
template <typename T>
Array<T> to_array(std::vector<T> values) {
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  T* data = owner->data();
  const auto size = static_cast<py::ssize_t>(owner->size());
  const py::capsule free(owner.get(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  owner.release();  // only once the capsule exists
  return Array<T>({size}, {static_cast<py::ssize_t>(sizeof(T))}, data, free);
}

std::int64_t check_points(const py::array& points) {
  if (points.ndim() != 2 || points.shape(1) != 3) throw std::invalid_argument("points must have shape (N, 3)");
  return points.shape(0);
}

template <typename T>
void check_features(const VertexTable& table, const Array<T>& features) {
  check_shape(features, table.num_rows(), kFeatureDim, "features");
}

// Checked arguments of the kernels that work on located points.
template <typename T>
PointBatch<T> point_batch(const VertexTable& table, const Array<T>& points, const Array<std::int32_t>& located,
                          const std::optional<Array<T>>& directions) {
  const std::int64_t count = check_points(points);
  check_shape(located, count, table.num_levels(), "located");
  if (directions) check_shape(*directions, count, 3, "directions");
  return {points.data(), directions ? directions->data() : nullptr, located.data(), count};
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
        check_shape(located, count, table.num_levels(), "located");
        const T* p = points.data();
        std::int32_t* found = located.mutable_data();
        const py::gil_scoped_release release;
        locate(table, p, count, found, num_threads);
      },
      "points"_a.noconvert(), "located"_a.noconvert(), "num_threads"_a = 0,
      "Writes the cell of each point (N, 3), local frame, m, at each level, or -1, to `located` (N, L) int32.");

  cls.def(
      "encode",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, Located& located, Rows<T>& out,
         int num_threads) {
        const std::int64_t count = check_points(points);
        check_features(table, features);
        check_shape(located, count, table.num_levels(), "located");
        check_shape(out, count, table.num_levels() * kFeatureDim, "out");
        const std::int64_t stride = row_stride(out, "out");
        const T *f = features.data(), *p = points.data();
        std::int32_t* found = located.mutable_data();
        T* result = out.mutable_data();
        const py::gil_scoped_release release;
        encode(table, f, p, count, found, result, stride, num_threads);
      },
      "features"_a.noconvert(), "points"_a.noconvert(), "located"_a.noconvert(), "out"_a.noconvert(),
      "num_threads"_a = 0, "Locates the points and writes their interpolated features to `out` (N, 8 L).");

  cls.def(
      "interpolate",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, const Located& located,
         const Directions& directions, Rows<T>& out, int num_threads) {
        const PointBatch<T> batch = point_batch(table, points, located, directions);
        check_features(table, features);
        check_shape(out, batch.count, table.num_levels() * kFeatureDim, "out");
        const std::int64_t stride = row_stride(out, "out");
        const T* f = features.data();
        T* result = out.mutable_data();
        const py::gil_scoped_release release;
        interpolate(table, f, batch, result, stride, num_threads);
      },
      "features"_a.noconvert(), "points"_a.noconvert(), "located"_a.noconvert(), "directions"_a.noconvert().none(true),
      "out"_a.noconvert(), "num_threads"_a = 0,
      "Like `encode` for located points; with `directions` (N, 3), the directional derivative of the features.");

  cls.def(
      "scatter",
      [](const VertexTable& table, const Array<T>& points, const Located& located, const Directions& directions,
         const Rows<T>& out_grad, Array<T>& features_grad, int num_threads) {
        const PointBatch<T> batch = point_batch(table, points, located, directions);
        check_features(table, features_grad);
        check_shape(out_grad, batch.count, table.num_levels() * kFeatureDim, "out_grad");
        const std::int64_t stride = row_stride(out_grad, "out_grad");
        const T* grad = out_grad.data();
        T* result = features_grad.mutable_data();
        const py::gil_scoped_release release;
        scatter(table, batch, grad, stride, result, num_threads);
      },
      "points"_a.noconvert(), "located"_a.noconvert(), "directions"_a.noconvert().none(true), "out_grad"_a.noconvert(),
      "features_grad"_a.noconvert(), "num_threads"_a = 0,
      "Adds the transpose of `interpolate`, applied to `out_grad` (N, 8 L), to `features_grad` (num_rows, 8).");

  cls.def(
      "adam_step",
      [](const VertexTable& table, const std::vector<std::tuple<Array<T>, Located, Rows<T>>>& batches,
         Array<T>& features, Array<T>& moments, Located& marks, const Array<T>& decays, std::int32_t step,
         double learning_rate, double epsilon, TaskQueue& queue) {
        const std::int64_t rows = table.num_rows();
        check_features(table, features);
        check_shape(moments, rows, 2 * kFeatureDim, "moments");
        check_shape(marks, rows, 2, "marks");
        if (step < 1) throw std::invalid_argument("step must be at least 1");
        if (decays.ndim() != 2 || decays.shape(0) <= step || decays.shape(1) != 2)
          throw std::invalid_argument("decays must have shape (more than step, 2)");
        std::vector<PointBatch<T>> points;
        std::vector<const T*> grads;
        std::vector<std::int64_t> strides;
        for (const auto& [batch_points, located, out_grad] : batches) {
          points.push_back(point_batch(table, batch_points, located, Directions()));
          check_shape(out_grad, points.back().count, table.num_levels() * kFeatureDim, "out_grad");
          grads.push_back(out_grad.data());
          strides.push_back(row_stride(out_grad, "out_grad"));
        }
        const T* powers = decays.data();
        const AdamStep<T> adam{features.mutable_data(),
                               moments.mutable_data(),
                               reinterpret_cast<RowMark*>(marks.mutable_data()),
                               powers,
                               step,
                               static_cast<T>(learning_rate / (1 - static_cast<double>(powers[2 * step]))),
                               static_cast<T>(1 / (1 - static_cast<double>(powers[2 * step + 1]))),
                               static_cast<T>(epsilon)};
        const py::gil_scoped_release release;
        adam_step(table, points, grads, strides, adam, queue);
      },
      "batches"_a, "features"_a.noconvert(), "moments"_a.noconvert(), "marks"_a.noconvert(), "decays"_a.noconvert(),
      "step"_a, "learning_rate"_a, "epsilon"_a, "queue"_a,
      "Moves the features that batches of (points, located, out_grad) touch by one step of Adam, as `scatter` sums "
      "their "
      "gradients: what no other call with the same `queue` has begun. `moments` (num_rows, 16) and `marks` (num_rows, "
      "2) int32, the step "
      "in which a row last moved and a zero, are its memory, `decays` (more than step, 2) the powers of both betas.");

  cls.def(
      "coordinate_gradient",
      [](const VertexTable& table, const Array<T>& features, const Array<T>& points, const Located& located,
         const Directions& directions, const Rows<T>& out_grad, Array<T>& points_grad, int num_threads) {
        const PointBatch<T> batch = point_batch(table, points, located, directions);
        check_features(table, features);
        check_shape(out_grad, batch.count, table.num_levels() * kFeatureDim, "out_grad");
        check_shape(points_grad, batch.count, 3, "points_grad");
        const std::int64_t stride = row_stride(out_grad, "out_grad");
        const T *f = features.data(), *grad = out_grad.data();
        T* result = points_grad.mutable_data();
        const py::gil_scoped_release release;
        coordinate_gradient(table, f, batch, grad, stride, result, num_threads);
      },
      "features"_a.noconvert(), "points"_a.noconvert(), "located"_a.noconvert(), "directions"_a.noconvert().none(true),
      "out_grad"_a.noconvert(), "points_grad"_a.noconvert(), "num_threads"_a = 0,
      "Writes the gradient of (interpolate . out_grad) by the points to `points_grad` (N, 3), 1/m.");
}

template <typename T>
void bind_cells(py::module_& m, py::class_<CellSet>& cls) {
  using namespace py::literals;
  m.def(
      "cell_keys",
      [](const Array<T>& points, double leaf_size_m, int num_threads) {
        std::vector<std::uint64_t> keys(static_cast<std::size_t>(check_points(points)));
        const T* p = points.data();
        {
          const py::gil_scoped_release release;
          cell_keys(p, static_cast<std::int64_t>(keys.size()), leaf_size_m, keys.data(), num_threads);
        }
        return to_array(std::move(keys));
      },
      "points"_a.noconvert(), "leaf_size_m"_a, "num_threads"_a = 0,
      "Morton key (N,) uint64 of the leaf cell of each point (N, 3), local frame, m.");
  cls.def(
      "insert",
      [](CellSet& cells, const Array<T>& points, int num_threads) {
        const std::int64_t count = check_points(points);
        const T* p = points.data();
        const py::gil_scoped_release release;
        cells.insert(p, count, num_threads);
      },
      "points"_a.noconvert(), "num_threads"_a = 0, "Marks the leaf cells that hold the points (N, 3), local frame, m.");
}

}  // namespace

void bind_vertex_table(py::module_& m) {
  using namespace py::literals;

  py::enum_<Encoding>(m, "Encoding", "Which vertices of a cell carry features.")
      .value("TRI_QUADTREE", Encoding::kTriQuadtree)
      .value("OCTREE", Encoding::kOctree);

  py::class_<CellSet> cell_set(m, "CellSet", "Set of occupied leaf cells, filled from points in chunks.");
  cell_set.def(py::init<double>(), "leaf_size_m"_a)
      .def("__len__", &CellSet::size)
      .def(
          "insert_rays",
          [](CellSet& cells, const Array<float>& points, const Array<float>& directions, double reach_m,
             int num_threads) {
            const std::int64_t count = check_points(points);
            check_shape(directions, count, 3, "directions");
            const float *p = points.data(), *d = directions.data();
            const py::gil_scoped_release release;
            cells.insert_rays(p, d, count, reach_m, num_threads);
          },
          "points"_a.noconvert(), "directions"_a.noconvert(), "reach_m"_a, "num_threads"_a = 0,
          "Marks the leaf cells that rays go through within `reach_m` before and behind their points (N, 3) float32, "
          "local frame, m; `directions` are unit vectors (N, 3) float32.")
      .def(
          "sorted_keys",
          [](const CellSet& cells, int num_threads) {
            std::vector<std::uint64_t> keys;
            {
              const py::gil_scoped_release release;
              keys = cells.sorted_keys(num_threads);
            }
            return to_array(std::move(keys));
          },
          "num_threads"_a = 0, "Morton keys of the cells (C,) uint64, ascending.");
  bind_cells<float>(m, cell_set);
  bind_cells<double>(m, cell_set);

  py::class_<VertexTable> table(m, "VertexTable", "From points to rows of the feature matrix (num_rows, 8).");
  table
      .def(py::init([](const Array<std::uint64_t>& leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
                       int num_threads) {
             std::vector<std::uint64_t> keys(leaf_keys.data(), leaf_keys.data() + leaf_keys.size());
             const py::gil_scoped_release release;
             return std::make_unique<VertexTable>(std::move(keys), leaf_size_m, num_levels, encoding, num_threads);
           }),
           "leaf_keys"_a.noconvert(), "leaf_size_m"_a, "num_levels"_a,
           py::arg_v("encoding", Encoding::kTriQuadtree, "Encoding.TRI_QUADTREE"), "num_threads"_a = 0)
      .def_property_readonly("num_rows", &VertexTable::num_rows)
      .def_property_readonly("num_cells", &VertexTable::num_cells)
      .def_property_readonly("num_levels", &VertexTable::num_levels)
      .def_property_readonly("leaf_size_m", &VertexTable::leaf_size_m)
      .def_property_readonly("encoding", &VertexTable::encoding)
      .def(
          "leaf_keys", [](const VertexTable& t) { return to_array(std::vector<std::uint64_t>(t.leaf_keys())); },
          "Morton keys of the occupied leaf cells (C,) uint64, ascending.")
      .def(
          "leaf_cells",
          [](const VertexTable& t) {
            const auto& keys = t.leaf_keys();
            std::vector<std::int32_t> cells;
            {
              const py::gil_scoped_release release;
              cells = leaf_coordinates(keys);
            }
            const auto count = static_cast<py::ssize_t>(keys.size());
            return Array<std::int32_t>(to_array(std::move(cells)).reshape({count, py::ssize_t{3}}));
          },
          "Lattice coordinates of the occupied leaf cells (C, 3) int32: cell i spans [i, i + 1) * leaf_size_m.");
  table
      .def(
          "leaf_vertices",
          [](const VertexTable& t) {
            LeafVertices vertices;
            {
              const py::gil_scoped_release release;
              vertices = leaf_vertices(t);
            }
            const auto rows = static_cast<py::ssize_t>(vertices.coordinates.size() / 3);
            const auto cells = static_cast<py::ssize_t>(vertices.of_cells.size() / 8);
            return std::make_pair(
                Array<std::int32_t>(to_array(std::move(vertices.coordinates)).reshape({rows, py::ssize_t{3}})),
                Array<std::int32_t>(to_array(std::move(vertices.of_cells)).reshape({cells, py::ssize_t{8}})));
          },
          "Of an octree: lattice coordinates (V, 3) int32 of the leaf cells' vertices, in the order of the feature "
          "matrix, whose first V rows are theirs, and the vertices (C, 8) int32 of each cell, in C order.")
      .def(
          "average_rays",
          [](const VertexTable& t, const Array<float>& points, const Array<float>& directions,
             const Array<float>& normals, const Array<float>& weights, double truncation_m, int num_threads) {
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
  py::class_<TaskQueue>(m, "TaskQueue", "What of an `adam_step` is left for whoever calls it next.").def(py::init<>());
  bind_kernels<float>(table);
  bind_kernels<double>(table);
}

}  // namespace radarsdf
