#include <memory>
#include <utility>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/growing_sums.hpp"

namespace radarsdf {
void bind_growing_sums(py::module_& m) {
  using namespace py::literals;
  py::class_<SumsChange>(m, "SumsChange", "Change of `GrowingSums` by added and removed scans.")
      .def(py::init<double, double>(), "leaf_size_m"_a, "quantum_m"_a)
      .def(
          "collect",
          [](SumsChange& change, const Array<float>& points, const Array<float>& directions,
             const Array<float>& ranges_m, const Array<std::int32_t>& weights, int sign) {
            const std::int64_t count = check_rays(points, directions, ranges_m);
            check_shape(weights, {count}, "weights");
            if (sign != 1 && sign != -1) throw std::invalid_argument("sign must be 1 or -1");
            const py::gil_scoped_release release;
            change.collect({points.data(), directions.data(), ranges_m.data(), weights.data(), count}, sign);
          },
          "points"_array, "directions"_array, "ranges_m"_array, "weights"_array, "sign"_a,
          "Adds (1) or removes (-1) a scan: `points`, `directions` (N, 3), `ranges_m` (N,) float32, local frame, m; "
          "and "
          "positive `weights` (N,) int32, with which the sums are multiplied.")
      .def(
          "block_keys", [](const SumsChange& change) { return to_array(change.block_keys()); },
          "Ascending keys of the blocks that may change, uint64.");
  py::class_<GrowingSums>(
      m, "GrowingSums",
      "Sums over scans in cells, and visibility counts of blocks of 8 x 8 x 8 cells, in a table that grows.")
      .def(py::init<>())
      .def_property_readonly("num_cells", &GrowingSums::num_cells)
      .def_property_readonly("num_bytes", &GrowingSums::num_bytes)
      .def(
          "apply",
          [](GrowingSums& sums, const SumsChange& change) {
            ChangedBlocks changed = without_gil([&] { return sums.apply(change); });
            return py::make_tuple(to_array(std::move(changed.returns)), to_array(std::move(changed.visibility)));
          },
          "change"_a,
          "Applies a change, completely or not at all. Returns the ascending keys of the blocks with changed sums and "
          "with changed visibility counts: two uint64 arrays.")
      .def(
          "block_keys", [](const GrowingSums& sums) { return to_array(sums.block_keys()); },
          "Ascending keys of all blocks, uint64.")
      .def(
          "sums_of",
          [](const GrowingSums& sums, const Array<std::uint64_t>& block_keys) {
            const std::int64_t count = check_column(block_keys, "block_keys");
            SumsOfCells found = without_gil([&] { return sums.sums_of(block_keys.data(), count); });
            return py::make_tuple(to_array(std::move(found.keys)), to_matrix(std::move(found.sums), kSums),
                                  to_array(std::move(found.scans)));
          },
          "block_keys"_array,
          "Contents of the blocks with ascending keys (B,): Morton keys (C,) of the leaf cells with returns, their "
          "sums (C, 14) int64, and numbers of scans (C,) uint32.")
      .def(
          "visibility_of",
          [](const GrowingSums& sums, const Array<std::uint64_t>& block_keys) {
            VisibilityOfBlocks found = sums.visibility_of(block_keys.data(), check_column(block_keys, "block_keys"));
            return py::make_tuple(to_array(std::move(found.keys)), to_array(std::move(found.visibility)));
          },
          "block_keys"_array,
          "Keys and visibility counts, uint32, of those blocks with ascending keys (B,) that are stored.")
      .def(
          "insert",
          [](GrowingSums& sums, const Array<std::uint64_t>& keys, const Array<std::int64_t>& of_cells,
             const Array<std::uint32_t>& scans, const Array<std::uint64_t>& visibility_keys,
             const Array<std::uint32_t>& visibility) {
            const std::int64_t cells = check_column(keys, "keys"),
                               blocks = check_column(visibility_keys, "visibility_keys");
            check_shape(of_cells, {cells, kSums}, "sums");
            check_shape(scans, {cells}, "scans");
            check_shape(visibility, {blocks}, "visibility");
            sums.insert({{keys.data(), keys.data() + cells},
                         {of_cells.data(), of_cells.data() + kSums * cells},
                         {scans.data(), scans.data() + cells}},
                        {{visibility_keys.data(), visibility_keys.data() + blocks},
                         {visibility.data(), visibility.data() + blocks}});
          },
          "keys"_array, "sums"_array, "scans"_array, "visibility_keys"_array, "visibility"_array,
          "Inserts blocks returned by `sums_of` and `visibility_of`.")
      .def(
          "erase",
          [](GrowingSums& sums, const Array<std::uint64_t>& block_keys) {
            sums.erase(block_keys.data(), check_column(block_keys, "block_keys"));
          },
          "block_keys"_array, "Removes blocks with their sums and visibility counts.");
}

}  // namespace radarsdf
