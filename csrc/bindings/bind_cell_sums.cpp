#include <memory>

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
             const std::uint64_t* k = keys.data();
             const py::gil_scoped_release release;
             return std::make_unique<CellBlocks>(k, count);
           }),
           "keys"_a.noconvert(), "`keys` (C,) uint64 of `cell_keys`, ascending and unique.")
      .def("__len__", &CellBlocks::size)
      .def(
          "rows",
          [](const CellBlocks& cells, const Array<std::uint64_t>& keys, int num_threads) {
            const std::int64_t count = check_column(keys, "keys");
            py::array_t<std::int32_t> rows(static_cast<py::ssize_t>(count));
            const std::uint64_t* k = keys.data();
            std::int32_t* result = rows.mutable_data();
            {
              const py::gil_scoped_release release;
              cells.rows(k, count, result, num_threads);
            }
            return rows;
          },
          "keys"_a.noconvert(), "num_threads"_a = 0, "Row of each key (N,) int32, -1 without a cell.")
      .def(
          "neighbour_sums",
          [](const CellBlocks& cells, const Array<std::uint64_t>& keys, const Array<double>& values, double weight,
             int num_threads) {
            const std::int64_t count = check_column(keys, "keys");
            const py::ssize_t columns = values.ndim() == 2 ? values.shape(1) : 0;
            check_shape(values, cells.size(), columns, "values");
            py::array_t<double> sums({static_cast<py::ssize_t>(count), columns});
            const std::uint64_t* k = keys.data();
            const double* v = values.data();
            double* result = sums.mutable_data();
            {
              const py::gil_scoped_release release;
              neighbour_sums(cells, k, count, v, static_cast<int>(columns), weight, result, num_threads);
            }
            return sums;
          },
          "keys"_a.noconvert(), "values"_a.noconvert(), "weight"_a, "num_threads"_a = 0,
          "Sums of `values` (C, K) float64 over the cell of each key and its 26 neighbours: (N, K). Cells across a "
          "face have the weight `weight`, across an edge its square, across a corner its cube.")
      .def(
          "interpolate",
          [](const CellBlocks& cells, double cell_size_m, const Array<float>& values, const Array<float>& points,
             int num_threads) {
            const py::ssize_t count = points.ndim() == 2 ? points.shape(0) : 0;
            check_shape(points, count, 3, "points");
            const py::ssize_t columns = values.ndim() == 2 ? values.shape(1) : 0;
            check_shape(values, cells.size(), columns, "values");
            py::array_t<float> interpolated({count, columns});
            const float *v = values.data(), *p = points.data();
            float* result = interpolated.mutable_data();
            {
              const py::gil_scoped_release release;
              interpolate_cells(cells, cell_size_m, v, static_cast<int>(columns), p, count, result, num_threads);
            }
            return interpolated;
          },
          "cell_size_m"_a, "values"_a.noconvert(), "points"_a.noconvert(), "num_threads"_a = 0,
          "Trilinear interpolation of `values` (C, K) float32 at the centres of cells, 0 without a cell, at `points` "
          "(N, 3) float32, local frame, m: (N, K).");
  m.def(
      "bridge_cells",
      [](const Array<std::uint64_t>& leaf_keys, const Array<std::uint64_t>& ends, const Array<double>& support,
         int max_cells, double least_dense, int num_threads) {
        const std::int64_t num_leaves = check_column(leaf_keys, "leaf_keys"), num_ends = check_column(ends, "ends");
        if (check_column(support, "support") != num_ends)
          throw std::invalid_argument("support must be one for each end");
        const std::uint64_t *k = leaf_keys.data(), *e = ends.data();
        const double* s = support.data();
        std::vector<std::uint64_t> keys;
        {
          const py::gil_scoped_release release;
          keys = bridge_cells(k, num_leaves, e, s, num_ends, max_cells, least_dense, num_threads);
        }
        return to_array(std::move(keys));
      },
      "leaf_keys"_a.noconvert(), "ends"_a.noconvert(), "support"_a.noconvert(), "max_cells"_a, "least_dense"_a,
      "num_threads"_a = 0,
      "Keys of `leaf_keys` (C,) and of the cells, at most `max_cells`, between pairs of `ends` (E,) along one of 13 "
      "directions, if the sum of the `support` (E,) float64 of both ends is below `least_dense`. All keys are uint64, "
      "ascending and unique.");
  m.def(
      "block_medians",
      [](const Array<std::uint64_t>& keys, const Array<double>& values, int levels, int num_threads) {
        const std::int64_t count = check_column(keys, "keys");
        if (check_column(values, "values") != count) throw std::invalid_argument("values must be one for each key");
        if (levels < 0 || levels > kAxisBits) throw std::invalid_argument("levels must be 0 to 21");
        py::array_t<double> medians(static_cast<py::ssize_t>(count));
        const std::uint64_t* k = keys.data();
        const double* v = values.data();
        double* result = medians.mutable_data();
        {
          const py::gil_scoped_release release;
          block_medians(k, v, count, levels, result, num_threads);
        }
        return medians;
      },
      "keys"_a.noconvert(), "values"_a.noconvert(), "levels"_a, "num_threads"_a = 0,
      "Medians (C,) of the positive `values` (C,) float64 in the block, of 2^`levels` cells per edge, that contains "
      "each "
      "cell with ascending Morton `keys` (C,) uint64; 0 without one.");
  m.attr("DIRECTION_QUANTA") = kDirectionQuanta;
  m.def(
      "sum_returns",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
         const Array<std::int32_t>& cells, const Array<std::uint64_t>& keys, double leaf_size_m, int num_threads) {
        const std::int64_t num_cells = check_column(keys, "keys");
        const std::int64_t count = check_cells_of_returns(cells, num_cells);
        check_shape(points, count, 3, "points");
        check_shape(directions, count, 3, "directions");
        if (check_column(ranges_m, "ranges_m") != count) throw std::invalid_argument("ranges_m must be one a return");
        if (!(leaf_size_m > 0)) throw std::invalid_argument("leaf_size_m must be positive");
        const ReturnsInCells returns{points.data(), directions.data(), ranges_m.data(), cells.data(), count};
        const std::uint64_t* k = keys.data();
        py::array_t<std::int64_t> sums({static_cast<py::ssize_t>(num_cells), py::ssize_t{kSums}});
        std::int64_t* result = sums.mutable_data();
        {
          const py::gil_scoped_release release;
          sum_returns(returns, k, num_cells, leaf_size_m, result, num_threads);
        }
        return sums;
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "ranges_m"_a.noconvert(), "cells"_a.noconvert(),
      "keys"_a.noconvert(), "leaf_size_m"_a, "num_threads"_a = 0,
      "Sums over the returns of each cell, (C, 14) int64: 1, x, y, z, xx, xy, xz, yy, yz, zz, direction, range. "
      "Lengths are in quanta, QUANTA per leaf cell, positions relative to the corners of the leaf cells with Morton "
      "`keys` (C,) uint64; directions are multiplied by DIRECTION_QUANTA. `points`, `directions` (N, 3) and `ranges_m` "
      "(N,) float32; `cells` (N,) int32, the row of each return's cell.");
  m.attr("QUANTA") = kQuanta;
  const auto check_sums = [](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums) {
    const std::int64_t count = check_column(keys, "keys");
    check_shape(sums, count, kSums, "sums");
    return count;
  };
  m.def(
      "merge_sums",
      [check_sums](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums, double leaf_size_m) {
        const std::int64_t count = check_sums(keys, sums);
        const std::uint64_t* k = keys.data();
        const std::int64_t* s = sums.data();
        Moments merged;
        {
          const py::gil_scoped_release release;
          merged = merge_sums(k, s, count, leaf_size_m);
        }
        const auto rows = static_cast<py::ssize_t>(merged.keys.size());
        return std::make_pair(
            to_array(std::move(merged.keys)),
            Array<double>(to_array(std::move(merged.numbers)).reshape({rows, py::ssize_t{kSums - 1}})));
      },
      "keys"_a.noconvert(), "sums"_a.noconvert(), "leaf_size_m"_a,
      "Ascending keys (P,) uint64 of the parents of leaf cells with ascending `keys` (C,), and moments (P, 13) float64 "
      "of their returns, local frame, m, from `sums` (C, 14) of `sum_returns`.");
  m.def(
      "mean_rays",
      [check_sums](const Array<std::uint64_t>& keys, const Array<std::int64_t>& sums, double leaf_size_m,
                   int num_threads) {
        const auto count = static_cast<py::ssize_t>(check_sums(keys, sums));
        Array<float> points({count, py::ssize_t{3}}), directions({count, py::ssize_t{3}}), ranges(count), counts(count);
        const MeanRays means{points.mutable_data(), directions.mutable_data(), ranges.mutable_data(),
                             counts.mutable_data()};
        const std::uint64_t* k = keys.data();
        const std::int64_t* s = sums.data();
        {
          const py::gil_scoped_release release;
          mean_rays(k, s, count, leaf_size_m, means, num_threads);
        }
        return std::make_tuple(points, directions, ranges, counts);
      },
      "keys"_a.noconvert(), "sums"_a.noconvert(), "leaf_size_m"_a, "num_threads"_a = 0,
      "Means of the returns in each leaf cell, from `sums` (C, 14) of `sum_returns`: points (C, 3), unit directions "
      "(C, 3) and ranges (C,), and their number (C,), float32, local frame, m.");
  m.def(
      "principal_axes",
      [](const Array<double>& matrices, int num_threads) {
        if (matrices.ndim() != 3 || matrices.shape(1) != 3 || matrices.shape(2) != 3) {
          throw std::invalid_argument("matrices must have shape (N, 3, 3)");
        }
        const py::ssize_t count = matrices.shape(0);
        py::array_t<double> values({count, py::ssize_t{3}}), vectors({count, py::ssize_t{3}, py::ssize_t{3}});
        const double* a = matrices.data();
        double *w = values.mutable_data(), *v = vectors.mutable_data();
        {
          const py::gil_scoped_release release;
          principal_axes(a, count, w, v, num_threads);
        }
        return std::make_pair(values, vectors);
      },
      "matrices"_a.noconvert(), "num_threads"_a = 0,
      "Ascending eigenvalues (N, 3), and eigenvectors (N, 3, 3) in columns, of symmetric `matrices` (N, 3, 3) "
      "float64.");
}

}  // namespace radarsdf
