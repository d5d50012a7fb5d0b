#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

VertexTableClass bind_vertex_table(py::module_& m) {
  using namespace py::literals;
  py::enum_<Encoding>(m, "Encoding", "Vertices of a cell that have features.")
      .value("TRI_QUADTREE", Encoding::kTriQuadtree)
      .value("OCTREE", Encoding::kOctree);

  VertexTableClass table(m, "VertexTable", "Look-up of rows of the feature matrix (num_rows, 8) for points.");
  table
      .def(py::init([](const Array<std::uint64_t>& leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
                       int num_threads) {
             std::vector<std::uint64_t> keys(leaf_keys.data(), leaf_keys.data() + leaf_keys.size());
             const py::gil_scoped_release release;
             return std::make_unique<VertexTable>(std::move(keys), leaf_size_m, num_levels, encoding, num_threads);
           }),
           "leaf_keys"_array, "leaf_size_m"_a, "num_levels"_a,
           py::arg_v("encoding", Encoding::kTriQuadtree, "Encoding.TRI_QUADTREE"), "num_threads"_a = 0)
      .def_property_readonly("num_rows", &VertexTable::num_rows)
      .def_property_readonly("num_cells", &VertexTable::num_cells)
      .def_property_readonly("num_levels", &VertexTable::num_levels)
      .def_property_readonly("leaf_size_m", &VertexTable::leaf_size_m)
      .def_property_readonly("encoding", &VertexTable::encoding)
      .def(
          "leaf_keys", [](const VertexTable& t) { return to_array(std::vector<std::uint64_t>(t.leaf_keys())); },
          "Ascending Morton keys of the occupied leaf cells (C,) uint64.")
      .def(
          "leaf_cells",
          [](const VertexTable& t) {
            return to_matrix(without_gil([&] { return leaf_coordinates(t.leaf_keys()); }), 3);
          },
          "Lattice coordinates of the occupied leaf cells (C, 3) int32: cell i spans [i, i + 1) * leaf_size_m.");
  table.def(
      "leaf_vertices",
      [](const VertexTable& t, int num_threads) {
        LeafVertices vertices = without_gil([&] { return leaf_vertices(t, num_threads); });
        return std::make_pair(to_matrix(std::move(vertices.coordinates), 3),
                              to_matrix(std::move(vertices.of_cells), 8));
      },
      "num_threads"_a = 0,
      "For an octree, lattice coordinates (V, 3) int32 of the vertices of leaf cells, which have the first V rows of "
      "the feature matrix, and the rows (C, 8) int32 of each cell's vertices in C order.");
  return table;
}

}  // namespace radarsdf
