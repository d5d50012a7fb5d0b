#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "lattice/cell_set.hpp"
#include "util/gather_rows.hpp"
#include "util/sorting.hpp"

namespace radarsdf {
namespace {

template <typename T>
void bind_cells(py::module_& m, py::class_<CellSet>& cls) {
  using namespace py::literals;
  m.def(
      "cell_keys",
      [](const Array<T>& points, double leaf_size_m, int num_threads) {
        const std::int64_t count = check_points(points);
        Array<std::uint64_t> keys = new_array<std::uint64_t>(count);
        without_gil([&] { cell_keys(points.data(), count, leaf_size_m, keys.mutable_data(), num_threads); });
        return keys;
      },
      "points"_array, "leaf_size_m"_a, "num_threads"_a = 0,
      "Morton key (N,) uint64 of the leaf cell of each point (N, 3), local frame, m.");
  cls.def(
      "insert",
      [](CellSet& cells, const Array<T>& points, int num_threads) {
        const std::int64_t count = check_points(points);
        const py::gil_scoped_release release;
        cells.insert(points.data(), count, num_threads);
      },
      "points"_array, "num_threads"_a = 0, "Inserts the leaf cells of points (N, 3), local frame, m.");
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
            check_shape(directions, {count, 3}, "directions");
            const py::gil_scoped_release release;
            cells.insert_along(points.data(), directions.data(), count, offsets_m.data(), num_offsets, num_threads);
          },
          "points"_array, "directions"_array, "offsets_m"_array, "num_threads"_a = 0,
          "Inserts the leaf cells of the points at distances `offsets_m` (K,) float32 behind the points (N, 3) float32 "
          "along the unit `directions` (N, 3) float32 of their rays, local frame, m.")
      .def(
          "insert_rays",
          [](CellSet& cells, const Array<float>& points, const Array<float>& directions, double reach_m,
             int num_threads) {
            const std::int64_t count = check_points(points);
            check_shape(directions, {count, 3}, "directions");
            const py::gil_scoped_release release;
            cells.insert_rays(points.data(), directions.data(), count, reach_m, num_threads);
          },
          "points"_array, "directions"_array, "reach_m"_a, "num_threads"_a = 0,
          "Inserts the leaf cells that rays cross within `reach_m` before and behind their points (N, 3) float32, "
          "local frame, m; `directions` are unit vectors (N, 3) float32.")
      .def(
          "sorted_keys",
          [](const CellSet& cells, int num_threads) {
            return to_array(without_gil([&] { return cells.sorted_keys(num_threads); }));
          },
          "num_threads"_a = 0, "Ascending Morton keys of the cells (C,) uint64.");
  m.def(
      "stable_order",
      [](const Array<std::uint64_t>& keys) {
        const std::int64_t count = check_column(keys, "keys");
        return to_array(without_gil([&] { return stable_order(keys.data(), count); }));
      },
      "keys"_array, "Permutation (N,) int32 that sorts `keys` (N,) uint64 in ascending order, stably.");
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
        check_shape(out, {count, columns}, "out");
        check_numbers(order, 0, rows, "order");
        const py::gil_scoped_release release;
        gather_rows(matrices, order.data(), count, out.mutable_data(), num_threads);
      },
      "blocks"_array, "order"_array, "out"_array, "num_threads"_a = 0,
      "Writes the rows `order` (M,) int32 of `blocks` (N, W) float32, concatenated, to `out` (M, sum of the W) "
      "float32.");
  bind_cells<float>(m, cell_set);
  bind_cells<double>(m, cell_set);
}

}  // namespace radarsdf
