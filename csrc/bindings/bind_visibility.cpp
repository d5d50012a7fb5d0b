#include <pybind11/stl.h>

#include <optional>

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
        const std::int64_t count = check_rays(points, directions, ranges_m);
        check_shape(scans, {count}, "scans");
        Array<std::uint32_t> visibility = new_array<std::uint32_t>(leaves);
        without_gil([&] {
          count_visibility(leaf_keys.data(), leaves, leaf_size_m, points.data(), directions.data(), ranges_m.data(),
                           scans.data(), count, visibility.mutable_data(), num_threads);
        });
        return visibility;
      },
      "leaf_keys"_array, "leaf_size_m"_a, "points"_array, "directions"_array, "ranges_m"_array, "scans"_array,
      "num_threads"_a = 0,
      "Visibility counts of leaf cells (C,) uint32: numbers of scans with a ray that crosses or ends in the block, of "
      "8 x 8 x 8 leaf cells. `leaf_keys` (C,) uint64, ascending; `points`, `directions` (N, 3), `ranges_m` (N,) "
      "float32, local frame, m; `scans` (N,) int32, ascending.");
  m.def(
      "count_scans",
      [](const Array<std::int32_t>& cells, const Array<std::int32_t>& scans, std::int64_t num_cells, int num_threads) {
        const std::int64_t count = check_cells_of_returns(cells, num_cells);
        check_shape(scans, {count}, "scans");
        Array<std::uint32_t> counts = new_array<std::uint32_t>(num_cells);
        without_gil(
            [&] { count_scans(cells.data(), scans.data(), count, num_cells, counts.mutable_data(), num_threads); });
        return counts;
      },
      "cells"_array, "scans"_array, "num_cells"_a, "num_threads"_a = 0,
      "Number of scans with returns in each cell: (num_cells,) uint32. `cells` (N,) int32, the row of each return's "
      "cell; `scans` (N,) int32, ascending.");
  m.def(
      "scan_rays",
      [](const Array<double>& points, const Array<std::int32_t>& scans, const Array<double>& rotations,
         const Array<double>& positions, const Array<double>& seen_from, double min_range_m,
         const Array<double>& max_ranges_m, int num_threads) {
        const std::int64_t count = check_points(points), num_scans = check_column(max_ranges_m, "max_ranges_m");
        if (check_cells_of_returns(scans, num_scans) != count) throw std::invalid_argument("scans must be (N,)");
        check_shape(rotations, {num_scans, 9}, "rotations");
        check_shape(positions, {num_scans, 3}, "positions");
        check_shape(seen_from, {num_scans, 3}, "seen_from");
        Array<bool> kept = new_array<bool>(count);
        Array<float> to = new_array<float>(count, 3), along = new_array<float>(count, 3),
                     ranges = new_array<float>(count);
        const PlacedScans placed{points.data(),    scans.data(),       count, rotations.data(), positions.data(),
                                 seen_from.data(), max_ranges_m.data()};
        const std::int64_t rows = without_gil([&] {
          return scan_rays(placed, min_range_m, kept.mutable_data(), to.mutable_data(), along.mutable_data(),
                           ranges.mutable_data(), num_threads);
        });
        const py::slice used(0, rows, 1);
        return py::make_tuple(kept, Array<float>(to[used]), Array<float>(along[used]), Array<float>(ranges[used]));
      },
      "points"_array, "scans"_array, "rotations"_array, "positions"_array, "seen_from"_array, "min_range_m"_a,
      "max_ranges_m"_array, "num_threads"_a = 0,
      "Selects `points` (N, 3) of `scans` (N,) int32, sensor frame, m, by range from the sensor: mask (N,) bool, and "
      "the K selected returns as rays: points and unit directions (K, 3) and ranges (K,) float32, local frame, m. "
      "`rotations` (F, 9) from sensor to world, `positions` (F, 3) of the sensor and `seen_from` (F, 3), the origins "
      "of the rays, local frame, m, `max_ranges_m` (F,), float64.");
  m.def(
      "hash_rays",
      [](const Array<float>& directions, const Array<float>& ranges_m, const std::optional<Array<float>>& intensities,
         int num_threads) {
        const std::int64_t count = check_points(directions, "directions");
        check_shape(ranges_m, {count}, "ranges_m");
        if (intensities) check_shape(*intensities, {count}, "intensities");
        Array<std::uint64_t> keys = new_array<std::uint64_t>(count);
        const float* values = intensities ? intensities->data() : nullptr;
        without_gil(
            [&] { hash_rays(directions.data(), ranges_m.data(), values, count, keys.mutable_data(), num_threads); });
        return keys;
      },
      "directions"_array, "ranges_m"_array, "intensities"_array, "num_threads"_a = 0,
      "Pseudo-random keys (N,) uint64 of rays, for samples that do not depend on their order. `directions` (N, 3), "
      "`ranges_m` (N,) and `intensities` (N,) or None, float32.");
}

}  // namespace radarsdf
