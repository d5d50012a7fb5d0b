#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/scan_rays.hpp"
#include "returns/visibility.hpp"

namespace radarsdf {

void bind_visibility(py::module_& m) {
  using namespace py::literals;
  m.def(
      "count_visibility",
      [](const Array<std::uint64_t>& leaf_keys, double leaf_size_m, const Array<float>& points,
         const Array<float>& directions, const Array<float>& ranges_m, const Array<std::int32_t>& scans,
         int num_threads) {
        const std::int64_t leaves = check_column(leaf_keys, "leaf_keys");
        const std::int64_t count = check_points(points);
        check_shape(directions, count, 3, "directions");
        if (ranges_m.ndim() != 1 || scans.ndim() != 1 || ranges_m.shape(0) != count || scans.shape(0) != count) {
          throw std::invalid_argument("ranges_m and scans must be one for each point");
        }
        py::array_t<std::uint32_t> visibility(static_cast<py::ssize_t>(leaves));
        const std::uint64_t* k = leaf_keys.data();
        const float *p = points.data(), *d = directions.data(), *r = ranges_m.data();
        const std::int32_t* s = scans.data();
        std::uint32_t* result = visibility.mutable_data();
        {
          const py::gil_scoped_release release;
          count_visibility(k, leaves, leaf_size_m, p, d, r, s, count, result, num_threads);
        }
        return visibility;
      },
      "leaf_keys"_a.noconvert(), "leaf_size_m"_a, "points"_a.noconvert(), "directions"_a.noconvert(),
      "ranges_m"_a.noconvert(), "scans"_a.noconvert(), "num_threads"_a = 0,
      "Visibility counts of leaf cells (C,) uint32: numbers of scans with a ray that crosses or ends in the block, of "
      "8 x 8 x 8 leaf cells. `leaf_keys` (C,) uint64, ascending; `points`, `directions` (N, 3), `ranges_m` (N,) "
      "float32, local frame, m; `scans` (N,) int32, ascending.");
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
      "Number of scans with returns in each cell: (num_cells,) uint32. `cells` (N,) int32, the row of each return's "
      "cell; `scans` (N,) int32, ascending.");
  m.def(
      "scan_rays",
      [](const Array<double>& points, const Array<std::int32_t>& scans, const Array<double>& rotations,
         const Array<double>& positions, const Array<double>& seen_from, double min_range_m,
         const Array<double>& max_ranges_m, int num_threads) {
        const std::int64_t count = check_points(points), num_scans = check_column(max_ranges_m, "max_ranges_m");
        if (check_cells_of_returns(scans, num_scans) != count) throw std::invalid_argument("scans must be (N,)");
        check_shape(rotations, num_scans, 9, "rotations");
        check_shape(positions, num_scans, 3, "positions");
        check_shape(seen_from, num_scans, 3, "seen_from");
        Array<bool> kept(static_cast<py::ssize_t>(count));
        Array<float> to({count, std::int64_t{3}}), along({count, std::int64_t{3}}), ranges(count);
        const PlacedScans placed{points.data(),    scans.data(),       count, rotations.data(), positions.data(),
                                 seen_from.data(), max_ranges_m.data()};
        bool* k = kept.mutable_data();
        float *p = to.mutable_data(), *d = along.mutable_data(), *r = ranges.mutable_data();
        std::int64_t rows = 0;
        {
          const py::gil_scoped_release release;
          rows = scan_rays(placed, min_range_m, k, p, d, r, num_threads);
        }
        const py::slice used(0, rows, 1);
        return py::make_tuple(kept, Array<float>(to[used]), Array<float>(along[used]), Array<float>(ranges[used]));
      },
      "points"_a.noconvert(), "scans"_a.noconvert(), "rotations"_a.noconvert(), "positions"_a.noconvert(),
      "seen_from"_a.noconvert(), "min_range_m"_a, "max_ranges_m"_a.noconvert(), "num_threads"_a = 0,
      "Selects `points` (N, 3) of `scans` (N,) int32, sensor frame, m, by range from the sensor: mask (N,) bool, and "
      "the K selected returns as rays: points and unit directions (K, 3) and ranges (K,) float32, local frame, m. "
      "`rotations` (F, 9) from sensor to world, `positions` (F, 3) of the sensor and `seen_from` (F, 3), the origins "
      "of the rays, local frame, m, `max_ranges_m` (F,), float64.");
}

}  // namespace radarsdf
