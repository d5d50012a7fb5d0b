#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <radarsdf/field/encodings.hpp>
#include <radarsdf/field/field_loss.hpp>
#include <radarsdf/lattice/cell_set.hpp>
#include <radarsdf/lattice/vertex_table.hpp>
#include <radarsdf/returns/principal_axes.hpp>
#include <radarsdf/surface/marching_cubes.hpp>
#include <vector>

// Constant features of one are interpolated to the number of corner groups.
int main() {
  const std::vector<double> points = {0.3, 0.4, 0.5, -1.2, 2.0, 0.1};
  radarsdf::CellSet cells(0.2);
  cells.insert(points.data(), 2, 0);
  const radarsdf::VertexTable table(cells.sorted_keys(0), 0.2, 1, radarsdf::Encoding::kTriQuadtree, 0);
  const std::vector<double> features(static_cast<std::size_t>(radarsdf::kFeatureDim * table.num_rows()), 1.0);
  std::vector<std::int32_t> located(2);
  std::vector<double> out(2 * radarsdf::kFeatureDim);
  radarsdf::encode(table, features.data(), points.data(), 2, located.data(), out.data(), radarsdf::kFeatureDim, 0);
  for (const double number : out) {
    if (std::abs(number - 3) > 1e-12) return EXIT_FAILURE;
  }
  std::printf("%d rows of features for two points\n", static_cast<int>(table.num_rows()));
  return EXIT_SUCCESS;
}
