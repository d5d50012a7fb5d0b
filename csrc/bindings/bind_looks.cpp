// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <algorithm>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/looks.hpp"

namespace radarsdf {

void bind_looks(py::module_& m) {
  using namespace py::literals;
  m.def(
      "count_looks",
      [](const Array<std::uint64_t>& leaf_keys, double leaf_size_m, const Array<float>& points,
         const Array<float>& directions, const Array<float>& ranges_m, const Array<std::int32_t>& scans,
         int num_threads) {
        if (leaf_keys.ndim() != 1) throw std::invalid_argument("leaf_keys must have shape (C,)");
        const std::int64_t count = check_points(points);
        check_shape(directions, count, 3, "directions");
        if (ranges_m.ndim() != 1 || scans.ndim() != 1 || ranges_m.shape(0) != count || scans.shape(0) != count) {
          throw std::invalid_argument("ranges_m and scans must be one for each point");
        }
        py::array_t<std::uint32_t> looks(leaf_keys.shape(0));
        const std::uint64_t* k = leaf_keys.data();
        const std::int64_t leaves = leaf_keys.shape(0);
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
      "count_scans",
      [](const Array<std::int32_t>& cells, const Array<std::int32_t>& scans, std::int64_t num_cells, int num_threads) {
        if (cells.ndim() != 1 || scans.ndim() != 1 || cells.shape(0) != scans.shape(0)) {
          throw std::invalid_argument("cells and scans must have shape (N,)");
        }
        const std::int64_t count = cells.shape(0);
        const std::int32_t *c = cells.data(), *s = scans.data();
        if (std::any_of(c, c + count, [&](std::int32_t cell) { return cell < 0 || cell >= num_cells; })) {
          throw std::invalid_argument("cells must lie in [0, num_cells)");
        }
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
