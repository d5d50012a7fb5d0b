#include <cmath>
#include <memory>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "returns/cell_means.hpp"

namespace radarsdf {
namespace {

std::vector<CellKind> kinds_of(const Array<double>& kinds) {
  const std::int64_t count = check_points(kinds, "kinds");
  std::vector<CellKind> found;
  for (std::int64_t i = 0; i < count; ++i) {
    const double* row = kinds.data(i, 0);
    if (!(std::isfinite(row[0]) && row[0] > 0 && row[1] >= 0 && row[2] >= 0)) {
      throw std::invalid_argument("kinds must have edges above 0 and steps of at least 0");
    }
    found.push_back({row[0], row[1], row[2]});
  }
  return found;
}

int check_tilings(int num_tilings) {
  if (num_tilings < 1) throw std::invalid_argument("num_tilings must be at least 1");
  return num_tilings;
}

Views views_of(const Array<float>& points, const Array<float>& directions, const Array<float>& incidence_rad) {
  const std::int64_t count = check_column(incidence_rad, "incidence_rad");
  check_shape(points, {count, 3}, "points");
  check_shape(directions, {count, 3}, "directions");
  return {points.data(), directions.data(), incidence_rad.data(), count};
}

}  // namespace

void bind_cell_means(py::module_& m) {
  using namespace py::literals;
  m.def(
      "cell_rows",
      [](const Array<double>& kind, const Array<float>& points, const Array<float>& directions,
         const Array<float>& incidence_rad) {
        const std::vector<CellKind> kinds = kinds_of(kind);
        if (kinds.size() != 1) throw std::invalid_argument("kind must be one");
        const Views views = views_of(points, directions, incidence_rad);
        Array<std::int32_t> rows = new_array<std::int32_t>(views.count);
        std::int64_t count = without_gil([&] { return cell_rows(kinds[0], views, rows.mutable_data()); });
        return std::make_pair(rows, count);
      },
      "kind"_array, "points"_array, "directions"_array, "incidence_rad"_array,
      "Cell indices of views (N,) int32, in order of first occurrence, and the number of cells. `kind` (1, 3).");
  m.def(
      "fit_cell_means",
      [](const Array<double>& kinds, int num_tilings, const Array<float>& points, const Array<float>& directions,
         const Array<float>& incidence_rad, const Array<float>& values, const Array<float>& weights, double shrinkage,
         int rounds, float least_mean, int num_threads) {
        const std::vector<CellKind> k = kinds_of(kinds);
        const int tilings = check_tilings(num_tilings);
        const Views views = views_of(points, directions, incidence_rad);
        check_shape(values, {views.count}, "values");
        check_shape(weights, {views.count}, "weights");
        if (!(shrinkage > 0)) throw std::invalid_argument("shrinkage must be above 0");
        CellMeans found = without_gil([&] {
          return fit_cell_means(k, tilings, views, values.data(), weights.data(), {shrinkage, rounds, least_mean},
                                num_threads);
        });
        return std::make_tuple(to_array(std::move(found.keys)), to_array(std::move(found.means)),
                               to_array(std::move(found.explained)));
      },
      "kinds"_array, "num_tilings"_a, "points"_array, "directions"_array, "incidence_rad"_array, "values"_array,
      "weights"_array, "shrinkage"_a, "rounds"_a, "least_mean"_a = 0, "num_threads"_a = 0,
      "Decomposes `values` (N,) into means in cells of several `kinds` (K, 3): cell edge (m), bin width of direction "
      "components, bin width of incidence (rad), 0 for no bins. `points`, `directions` (N, 3) float32, `incidence_rad` "
      "(N,), NaN if unknown. Returns keys (M,) uint64 and means (M,) float32 of the cells, without means smaller than "
      "`least_mean`, and the fitted part of each value (N,).");
  py::class_<CellMeansAt>(m, "CellMeans", "Look-up of means in cells.")
      .def(py::init([](const Array<double>& kinds, int num_tilings, const Array<std::uint64_t>& keys,
                       const Array<float>& means) {
             std::vector<CellKind> k = kinds_of(kinds);
             const int tilings = check_tilings(num_tilings);
             const std::int64_t count = check_column(keys, "keys");
             check_shape(means, {count}, "means");
             const py::gil_scoped_release release;
             return std::make_unique<CellMeansAt>(std::move(k), tilings, keys.data(), means.data(), count);
           }),
           "kinds"_array, "num_tilings"_a, "keys"_array, "means"_array,
           "Keys and means returned by `fit_cell_means` for the same `kinds` and `num_tilings`.")
      .def(
          "sums",
          [](const CellMeansAt& cells, const Array<float>& points, const Array<float>& directions,
             const Array<float>& incidence_rad, int num_threads) {
            const Views views = views_of(points, directions, incidence_rad);
            Array<float> sums = new_array<float>(views.count);
            without_gil([&] { cells.sums(views, sums.mutable_data(), num_threads); });
            return sums;
          },
          "points"_array, "directions"_array, "incidence_rad"_array, "num_threads"_a = 0,
          "Means of the cells of each view, summed over kinds and averaged over tilings: (N,) float32.");
}

}  // namespace radarsdf
