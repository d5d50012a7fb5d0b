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
        const std::int64_t count = check_points(points);
        check_shape(directions, count, 3, "directions");
        if (check_column(ranges_m, "ranges_m") != count || check_column(passed_m, "passed_m") != count ||
            check_column(scans, "scans") != count) {
          throw std::invalid_argument("ranges_m, passed_m and scans must be one for each point");
        }
        const float *p = points.data(), *d = directions.data(), *r = ranges_m.data(), *w = passed_m.data();
        const std::int32_t* s = scans.data();
        FreeSpace found;
        {
          const py::gil_scoped_release release;
          found = find_free_space(p, d, r, w, s, count, leaf_size_m, lower.data(), upper.data(), num_threads);
        }
        const auto blocks = static_cast<py::ssize_t>(found.keys.size());
        const py::array planes = to_array(std::move(found.planes))
                                     .reshape({blocks, py::ssize_t{kFreeSpacePlanes}, py::ssize_t{kFreeSpaceWords}});
        return py::make_tuple(to_array(std::move(found.keys)), Array<std::uint64_t>(planes));
      },
      "points"_a.noconvert(), "directions"_a.noconvert(), "ranges_m"_a.noconvert(), "passed_m"_a.noconvert(),
      "scans"_a.noconvert(), "leaf_size_m"_a, "lower"_a, "upper"_a, "num_threads"_a = 0,
      "Leaf cells crossed by rays from the sensor to the range `passed_m`, and leaf cells with returns: ascending keys "
      "(B,) uint64 of blocks of 8 x 8 x 8 leaf cells, and their bit planes (B, 4, 8) uint64. Three planes are the "
      "number of scans with a crossing, at most 7. `points`, `directions` (N, 3), `ranges_m`, `passed_m` (N,) float32, "
      "local frame, m; `scans` (N,) int32, ascending; blocks outside leaf cells [`lower`, `upper`) (3,) are omitted.");
}

}  // namespace radarsdf
