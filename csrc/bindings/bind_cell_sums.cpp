#include <memory>
#include <optional>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "returns/bridges.hpp"
#include "returns/cell_sums.hpp"
#include "returns/principal_axes.hpp"

namespace radarsdf {
void bind_cell_sums(py::module_& m) {
  using namespace py::literals;
  py::class_<CellBlocks>(m, "CellBlocks", "Rows of cells by key, and sums over the neighbourhoods of cells.")
      .def(py::init([](const Array<std::uint64_t>& keys) {
             const std::int64_t count = check_column(keys, "keys");
             const py::gil_scoped_release release;
             return std::make_unique<CellBlocks>(keys.data(), count);
           }),
           "keys"_array, "`keys` (C,) uint64 of `cell_keys`, ascending and unique.")
      .def("__len__", &CellBlocks::size)
      .def(
          "rows",
          [](const CellBlocks& cells, const Array<std::uint64_t>& keys, int num_threads) {
            const std::int64_t count = check_column(keys, "keys");
            Array<std::int32_t> rows = new_array<std::int32_t>(count);
            without_gil([&] { cells.rows(keys.data(), count, rows.mutable_data(), num_threads); });
            return rows;
          },
          "keys"_array, "num_threads"_a = 0, "Row of each key (N,) int32, -1 without a cell.")
      .def(
          "neighbour_sums",
          [](const CellBlocks& cells, const Array<std::uint64_t>& keys, const Array<double>& values, double weight,
             int num_threads) {
            const std::int64_t count = check_column(keys, "keys");
            const py::ssize_t columns = values.ndim() == 2 ? values.shape(1) : 0;
            check_shape(values, {cells.size(), columns}, "values");
            Array<double> sums = new_array<double>(count, columns);
            without_gil([&] {
              neighbour_sums(cells, keys.data(), count, values.data(), static_cast<int>(columns), weight,
                             sums.mutable_data(), num_threads);
            });
            return sums;
          },
          "keys"_array, "values"_array, "weight"_a, "num_threads"_a = 0,
          "Sums of `values` (C, K) float64 over the cell of each key and its 26 neighbours: (N, K). Cells across a "
          "face have the weight `weight`, across an edge its square, across a corner its cube.")
      .def(
          "interpolate",
          [](const CellBlocks& cells, double cell_size_m, const Array<float>& values, const Array<float>& points,
             int num_threads) {
            const std::int64_t count = check_points(points);
            const py::ssize_t columns = values.ndim() == 2 ? values.shape(1) : 0;
            check_shape(values, {cells.size(), columns}, "values");
            Array<float> interpolated = new_array<float>(count, columns);
            without_gil([&] {
              interpolate_cells(cells, cell_size_m, values.data(), static_cast<int>(columns), points.data(), count,
                                interpolated.mutable_data(), num_threads);
            });
            return interpolated;
          },
          "cell_size_m"_a, "values"_array, "points"_array, "num_threads"_a = 0,
          "Trilinear interpolation of `values` (C, K) float32 at the centres of cells, 0 without a cell, at `points` "
          "(N, 3) float32, local frame, m: (N, K).");
  m.def(
      "bridge_cells",
      [](const Array<std::uint64_t>& leaf_keys, const Array<std::uint64_t>& ends, const Array<double>& support,
         int max_cells, double least_dense, int num_threads) {
        const std::int64_t num_leaves = check_column(leaf_keys, "leaf_keys"), num_ends = check_column(ends, "ends");
        check_shape(support, {num_ends}, "support");
        return to_array(without_gil([&] {
          return bridge_cells(leaf_keys.data(), num_leaves, ends.data(), support.data(), num_ends, max_cells,
                              least_dense, num_threads);
        }));
      },
      "leaf_keys"_array, "ends"_array, "support"_array, "max_cells"_a, "least_dense"_a, "num_threads"_a = 0,
      "Keys of `leaf_keys` (C,) and of the cells, at most `max_cells`, between pairs of `ends` (E,) along one of 13 "
      "directions, if the sum of the `support` (E,) float64 of both ends is below `least_dense`. All keys are uint64, "
      "ascending and unique.");
  m.def(
      "block_medians",
      [](const Array<std::uint64_t>& keys, const Array<double>& values, int levels, int num_threads) {
        const std::int64_t count = check_column(keys, "keys");
        check_shape(values, {count}, "values");
        if (levels < 0 || levels > kAxisBits) throw std::invalid_argument("levels must be 0 to 21");
        Array<double> medians = new_array<double>(count);
        without_gil(
            [&] { block_medians(keys.data(), values.data(), count, levels, medians.mutable_data(), num_threads); });
        return medians;
      },
      "keys"_array, "values"_array, "levels"_a, "num_threads"_a = 0,
      "Medians (C,) of the positive `values` (C,) float64 in the block, of 2^`levels` cells per edge, that contains "
      "each cell with ascending Morton `keys` (C,) uint64; 0 without one.");
  m.attr("DIRECTION_QUANTA") = kDirectionQuanta;
  m.def(
      "sum_returns",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
         const Array<std::int32_t>& cells, const Array<std::uint64_t>& keys, double leaf_size_m, int num_threads,
         const std::optional<Array<std::int32_t>>& weights) {
        const std::int64_t num_cells = check_column(keys, "keys");
        const std::int64_t count = check_cells_of_returns(cells, num_cells);
        check_shape(cells, {check_rays(points, directions, ranges_m)}, "cells");
        if (weights) check_shape(*weights, {count}, "weights");
        if (!(leaf_size_m > 0)) throw std::invalid_argument("leaf_size_m must be positive");
        const ReturnsInCells returns{points.data(),   directions.data(),
                                     ranges_m.data(), cells.data(),
                                     count,           weights ? weights->data() : nullptr};
        Array<std::int64_t> sums = new_array<std::int64_t>(num_cells, kSums);
        without_gil(
            [&] { sum_returns(returns, keys.data(), num_cells, leaf_size_m, sums.mutable_data(), num_threads); });
        return sums;
      },
      "points"_array, "directions"_array, "ranges_m"_array, "cells"_array, "keys"_array, "leaf_size_m"_a,
      "num_threads"_a = 0, "weights"_array = py::none(),
      "Sums over the returns of each cell, (C, 14) int64: 1, x, y, z, xx, xy, xz, yy, yz, zz, direction, range. "
      "Lengths are in quanta, QUANTA per leaf cell, positions relative to the corners of the leaf cells with Morton "
      "`keys` (C,) uint64; directions are multiplied by DIRECTION_QUANTA. `points`, `directions` (N, 3) and `ranges_m` "
      "(N,) float32; `cells` (N,) int32, the row of each return's cell; "
      "`weights` (N,) int32, with which the sums are multiplied, or None for 1.");
  m.attr("QUANTA") = kQuanta;
  const auto check_sums = [](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums) {
    const std::int64_t count = check_column(keys, "keys");
    check_shape(sums, {count, kSums}, "sums");
    return count;
  };
  m.def(
      "merge_sums",
      [check_sums](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums, double leaf_size_m) {
        const std::int64_t count = check_sums(keys, sums);
        Moments merged = without_gil([&] { return merge_sums(keys.data(), sums.data(), count, leaf_size_m); });
        return std::make_pair(to_array(std::move(merged.keys)), to_matrix(std::move(merged.numbers), kSums - 1));
      },
      "keys"_array, "sums"_array, "leaf_size_m"_a,
      "Ascending keys (P,) uint64 of the parents of leaf cells with ascending `keys` (C,), and moments (P, 13) float64 "
      "of their returns, local frame, m, from `sums` (C, 14) of `sum_returns`.");
  m.def(
      "mean_rays",
      [check_sums](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums, double leaf_size_m,
                   int num_threads) {
        const std::int64_t count = check_sums(keys, sums);
        Array<float> points = new_array<float>(count, 3), directions = new_array<float>(count, 3),
                     ranges = new_array<float>(count), counts = new_array<float>(count);
        const MeanRays means{points.mutable_data(), directions.mutable_data(), ranges.mutable_data(),
                             counts.mutable_data()};
        without_gil([&] { mean_rays(keys.data(), sums.data(), count, leaf_size_m, means, num_threads); });
        return std::make_tuple(points, directions, ranges, counts);
      },
      "keys"_array, "sums"_array, "leaf_size_m"_a, "num_threads"_a = 0,
      "Means of the returns in each leaf cell, from `sums` (C, 14) of `sum_returns`: points (C, 3), unit directions "
      "(C, 3) and ranges (C,), and their number (C,), float32, local frame, m.");
  m.def(
      "principal_axes",
      [](const Array<double>& matrices, int num_threads) {
        const std::int64_t count = matrices.ndim() == 3 ? matrices.shape(0) : 0;
        check_shape(matrices, {count, 3, 3}, "matrices");
        Array<double> values = new_array<double>(count, 3), vectors = new_array<double>(count, 3, 3);
        without_gil([&] {
          principal_axes(matrices.data(), count, values.mutable_data(), vectors.mutable_data(), num_threads);
        });
        return std::make_pair(values, vectors);
      },
      "matrices"_array, "num_threads"_a = 0,
      "Ascending eigenvalues (N, 3), and eigenvectors (N, 3, 3) in columns, of symmetric `matrices` (N, 3, 3) "
      "float64.");
}

}  // namespace radarsdf
