#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "lattice/cell_set.hpp"
#include "util/gather_rows.hpp"
#include "util/stable_order.hpp"

namespace radarsdf {
namespace {

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
      "points"_a.noconvert(), "num_threads"_a = 0, "Inserts the leaf cells of points (N, 3), local frame, m.");
}

}  // namespace

void bind_cell_set(py::module_& m) {
  using namespace py::literals;
  py::class_<CellSet> cell_set(m, "CellSet", "Set of occupied leaf cells, filled from points in chunks.");
  cell_set.def(py::init<double>(), "leaf_size_m"_a)
      .def("__len__", &CellSet::size)
      .def(
          "insert_along",
          [](CellSet& cells, const Array<float>& points, const Array<float>& directions, const Array<float>& offsets_m,
             int num_threads) {
            const std::int64_t count = check_points(points), num_offsets = check_column(offsets_m, "offsets_m");
            check_shape(directions, count, 3, "directions");
            const float *p = points.data(), *d = directions.data(), *o = offsets_m.data();
            const py::gil_scoped_release release;
            cells.insert_along(p, d, count, o, num_offsets, num_threads);
          },
          "points"_a.noconvert(), "directions"_a.noconvert(), "offsets_m"_a.noconvert(), "num_threads"_a = 0,
          "Inserts the leaf cells of the points at distances `offsets_m` (K,) float32 behind the points (N, 3) float32 "
          "along the unit `directions` (N, 3) float32 of their rays, local frame, m.")
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
          "Inserts the leaf cells that rays cross within `reach_m` before and behind their points (N, 3) float32, "
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
          "num_threads"_a = 0, "Ascending Morton keys of the cells (C,) uint64.");
  m.def(
      "stable_order",
      [](const Array<std::uint64_t>& keys) {
        const std::int64_t count = check_column(keys, "keys");
        const std::uint64_t* k = keys.data();
        std::vector<std::int32_t> order;
        {
          const py::gil_scoped_release release;
          order = stable_order(k, count);
        }
        return to_array(std::move(order));
      },
      "keys"_a.noconvert(), "Permutation (N,) int32 that sorts `keys` (N,) uint64 in ascending order, stably.");
  m.def(
      "gather_rows",
      [](const std::vector<Array<float>>& blocks, const Array<std::int32_t>& order, Array<float>& out,
         int num_threads) {
        const std::int64_t count = check_column(order, "order");
        std::vector<Block<float>> matrices;
        std::int64_t columns = 0, rows = -1;
        for (const Array<float>& block : blocks) {
          if (block.ndim() != 2) throw std::invalid_argument("blocks must be matrices");
          if (rows >= 0 && block.shape(0) != rows) throw std::invalid_argument("blocks must have the same rows");
          rows = block.shape(0);
          columns += block.shape(1);
          matrices.push_back({block.data(), block.shape(1)});
        }
        check_shape(out, count, columns, "out");
        const std::int32_t* from = order.data();
        if (std::any_of(from, from + count, [&](std::int32_t row) { return row < 0 || row >= rows; })) {
          throw std::invalid_argument("order must lie in [0, rows)");
        }
        float* to = out.mutable_data();
        const py::gil_scoped_release release;
        gather_rows(matrices, from, count, to, num_threads);
      },
      "blocks"_a.noconvert(), "order"_a.noconvert(), "out"_a.noconvert(), "num_threads"_a = 0,
      "Writes the rows `order` (M,) int32 of `blocks` (N, W) float32, concatenated, to `out` (M, sum of the W) "
      "float32.");
  bind_cells<float>(m, cell_set);
  bind_cells<double>(m, cell_set);
}

}  // namespace radarsdf
