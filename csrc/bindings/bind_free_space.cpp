#include <pybind11/stl.h>

#include <array>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/free_space.hpp"

namespace radarsdf {

void bind_free_space(py::module_& m) {
  using namespace py::literals;
  m.def(
      "find_free_space",
      [](const Array<float>& points, const Array<float>& directions, const Array<float>& ranges_m,
         const Array<float>& passed_m, const Array<std::int32_t>& scans, double leaf_size_m,
         const std::array<std::int32_t, 3>& lower, const std::array<std::int32_t, 3>& upper, int num_threads) {
        const std::int64_t count = check_rays(points, directions, ranges_m);
        check_shape(passed_m, {count}, "passed_m");
        check_shape(scans, {count}, "scans");
        FreeSpace found = without_gil([&] {
          return find_free_space(points.data(), directions.data(), ranges_m.data(), passed_m.data(), scans.data(),
                                 count, leaf_size_m, lower.data(), upper.data(), num_threads);
        });
        const auto blocks = static_cast<py::ssize_t>(found.keys.size());
        const py::array planes = to_array(std::move(found.planes))
                                     .reshape({blocks, py::ssize_t{kFreeSpacePlanes}, py::ssize_t{kFreeSpaceWords}});
        return py::make_tuple(to_array(std::move(found.keys)), Array<std::uint64_t>(planes));
      },
      "points"_array, "directions"_array, "ranges_m"_array, "passed_m"_array, "scans"_array, "leaf_size_m"_a, "lower"_a,
      "upper"_a, "num_threads"_a = 0,
      "Leaf cells crossed by rays from the sensor to the range `passed_m`, and leaf cells with returns: ascending keys "
      "(B,) uint64 of blocks of 8 x 8 x 8 leaf cells, and their bit planes (B, 4, 8) uint64. Three planes are the "
      "number of scans with a crossing, at most 7. `points`, `directions` (N, 3), `ranges_m`, `passed_m` (N,) float32, "
      "local frame, m; `scans` (N,) int32, ascending; blocks outside leaf cells [`lower`, `upper`) (3,) are omitted.");
}

}  // namespace radarsdf
