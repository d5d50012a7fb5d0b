// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/column_sample.hpp"
#include "returns/looks.hpp"

namespace radarsdf {
namespace {

ColumnSample check_sample(std::int64_t column, double share) {
  if (column < 1 || !(share >= 0 && share <= 1)) {
    throw std::invalid_argument("column must be at least 1, and share from 0 to 1");
  }
  return {column, share};
}

}  // namespace

void bind_looks(py::module_& m) {
  using namespace py::literals;
  m.def(
      "count_looks",
      [](const Array<std::uint64_t>& leaf_keys, double leaf_size_m, const Array<float>& points,
         const Array<float>& directions, const Array<float>& ranges_m, const Array<std::int32_t>& scans,
         int num_threads) {
        const std::int64_t leaves = check_column(leaf_keys, "leaf_keys");
        const std::int64_t count = check_points(points);
        check_shape(directions, count, 3, "directions");
        if (ranges_m.ndim() != 1 || scans.ndim() != 1 || ranges_m.shape(0) != count || scans.shape(0) != count) {
          throw std::invalid_argument("ranges_m and scans must be one for each point");
        }
        py::array_t<std::uint32_t> looks(static_cast<py::ssize_t>(leaves));
        const std::uint64_t* k = leaf_keys.data();
        const float *p = points.data(), *d = directions.data(), *r = ranges_m.data();
        const std::int32_t* s = scans.data();
        std::uint32_t* result = looks.mutable_data();
        {
          const py::gil_scoped_release release;
          count_looks(k, leaves, leaf_size_m, p, d, r, s, count, result, num_threads);
        }
        return looks;
      },
      "leaf_keys"_a.noconvert(), "leaf_size_m"_a, "points"_a.noconvert(), "directions"_a.noconvert(),
      "ranges_m"_a.noconvert(), "scans"_a.noconvert(), "num_threads"_a = 0,
      "For each leaf cell (C,) the number of scans with a ray through its cube of 8 x 8 x 8 leaf cells, or to there: "
      "(C,) uint32. `leaf_keys` (C,) uint64, ascending; `points`, `directions` (N, 3), `ranges_m` (N,) float32, local "
      "frame, m; `scans` (N,) int32, ascending.");
  m.def(
      "sample_cells",
      [](const Array<std::int64_t>& cells, std::int64_t column, double share, int num_threads) {
        const ColumnSample sample = check_sample(column, share);
        const py::ssize_t count = cells.ndim() == 2 ? cells.shape(0) : 0, dims = cells.ndim() == 2 ? cells.shape(1) : 0;
        check_shape(cells, count, dims, "cells");
        py::array_t<bool> chosen(count);
        const std::int64_t* c = cells.data();
        auto* result = reinterpret_cast<std::uint8_t*>(chosen.mutable_data());
        {
          const py::gil_scoped_release release;
          sample_cells(sample, c, count, static_cast<int>(dims), result, num_threads);
        }
        return chosen;
      },
      "cells"_a.noconvert(), "column"_a, "share"_a, "num_threads"_a = 0,
      "Whether each cell is in the sample, (N,) bool: a hash chooses this `share` of all columns of `column` cells an "
      "edge. `cells` (N, K) int64, lattice coordinates.");
  m.def(
      "sample_rays",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& offsets_m,
         const std::vector<int>& axes, double cell_size_m, std::int64_t column, double share, int num_threads) {
        const ColumnSample sample = check_sample(column, share);
        const std::int64_t count = check_points(points), num_offsets = check_column(offsets_m, "offsets_m");
        check_shape(directions, count, 3, "directions");
        if (axes.size() > 3 || std::any_of(axes.begin(), axes.end(), [](int axis) { return axis < 0 || axis > 2; })) {
          throw std::invalid_argument("axes must be some of 0, 1 and 2");
        }
        py::array_t<bool> chosen(static_cast<py::ssize_t>(count));
        const float *p = points.data(), *d = directions.data(), *o = offsets_m.data();
        auto* result = reinterpret_cast<std::uint8_t*>(chosen.mutable_data());
        {
          const py::gil_scoped_release release;
          sample_rays(sample, cell_size_m, p, d, count, o, num_offsets, axes.data(), static_cast<int>(axes.size()),
                      result, num_threads);
        }
        return chosen;
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "offsets_m"_a.noconvert(), "axes"_a, "cell_size_m"_a,
      "column"_a, "share"_a, "num_threads"_a = 0,
      "Whether a point `offsets_m` (K,) behind each of the `points` (N, 3), along the rays' `directions` (N, 3), is in "
      "the sample by these of its coordinates, (N,) bool; see `sample_cells`. All float32, local frame, m.");
  m.def(
      "count_scans",
      [](const Array<std::int32_t>& cells, const Array<std::int32_t>& scans, std::int64_t num_cells, int num_threads) {
        const std::int64_t count = check_cells_of_returns(cells, num_cells);
        if (check_column(scans, "scans") != count) throw std::invalid_argument("scans must be one for each return");
        const std::int32_t *c = cells.data(), *s = scans.data();
        py::array_t<std::uint32_t> counts(static_cast<py::ssize_t>(num_cells));
        std::uint32_t* result = counts.mutable_data();
        {
          const py::gil_scoped_release release;
          count_scans(c, s, count, num_cells, result, num_threads);
        }
        return counts;
      },
      "cells"_a.noconvert(), "scans"_a.noconvert(), "num_cells"_a, "num_threads"_a = 0,
      "Number of different scans with returns in each cell: (num_cells,) uint32. `cells` (N,) int32, the row of each "
      "return's cell; `scans` (N,) int32, ascending.");
}

}  // namespace radarsdf
