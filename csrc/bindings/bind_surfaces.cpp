#include <pybind11/stl.h>
#include <pybind11/typing.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "surface/grid_surface.hpp"
#include "surface/marching_cubes.hpp"
#include "surface/mesh_components.hpp"
#include "surface/sparse_lattice.hpp"

namespace radarsdf {
namespace {

// NumPy array that takes ownership of the memory.
template <typename T>
py::array_t<T> adopt(std::unique_ptr<T[]> data, const std::vector<py::ssize_t>& shape) {
  const py::capsule owner(data.get(), [](void* memory) { delete[] static_cast<T*>(memory); });
  return py::array_t<T>(shape, data.release(), owner);
}

// Return types, explicit for the type stub.
template <typename... T>
using ArrayTuple = py::typing::Tuple<py::array_t<T>...>;

using DenseEdges = ArrayTuple<double, std::int32_t, std::int64_t>;

ArrayTuple<double, std::int32_t> adopt_mesh(Mesh mesh) {
  return py::make_tuple(adopt(std::move(mesh.vertices), {mesh.num_vertices, 3}),
                        adopt(std::move(mesh.faces), {mesh.num_faces, 3}));
}

py::tuple adopt_mesh_with_edges(Mesh mesh) {
  py::array edges = adopt(std::move(mesh.edges), {mesh.num_vertices});
  return adopt_mesh(std::move(mesh)) + py::make_tuple(std::move(edges));
}

std::array<std::int64_t, 3> shape_of_volume(const py::array& volume) {
  if (volume.ndim() != 3) throw std::invalid_argument("volume must have three axes");
  return {volume.shape(0), volume.shape(1), volume.shape(2)};
}

template <typename T>
Mesh dense_mesh(const Array<T>& volume, const std::optional<Array<bool>>& mask, const std::array<double, 3>& spacing,
                const std::array<double, 3>& origin, double level, int num_threads, bool with_edges) {
  const auto shape = shape_of_volume(volume);
  if (mask) check_shape(*mask, {shape[0], shape[1], shape[2]}, "mask");
  const bool* flags = mask ? mask->data() : nullptr;
  const py::gil_scoped_release nogil;
  return marching_cubes_dense(volume.data(), shape, flags, {spacing, origin}, level, num_threads, with_edges);
}

template <typename T>
ArrayTuple<double, std::int32_t> dense(const Array<T>& volume, const std::optional<Array<bool>>& mask,
                                       const std::array<double, 3>& spacing, const std::array<double, 3>& origin,
                                       double level, int num_threads) {
  return adopt_mesh(dense_mesh(volume, mask, spacing, origin, level, num_threads, false));
}

template <typename T>
DenseEdges dense_with_edges(const Array<T>& volume, const std::optional<Array<bool>>& mask,
                            const std::array<double, 3>& spacing, const std::array<double, 3>& origin, double level,
                            int num_threads) {
  return adopt_mesh_with_edges(dense_mesh(volume, mask, spacing, origin, level, num_threads, true));
}

template <typename T>
ArrayTuple<double, std::int32_t> sparse(const Array<std::int32_t>& corners, const Array<T>& values,
                                        const Array<std::int32_t>& cells, const std::array<double, 3>& spacing,
                                        const std::array<double, 3>& origin, double level, int num_threads) {
  const std::int64_t num_corners = check_points(corners, "corners"), num_cells = check_rows(cells, 8, "cells");
  check_shape(values, {num_corners}, "values");
  return adopt_mesh(without_gil([&] {
    return marching_cubes_sparse(corners.data(), values.data(), num_corners, cells.data(), num_cells, {spacing, origin},
                                 level, num_threads);
  }));
}

template <typename T>
void dense_backward(const Array<T>& volume, const Array<std::int64_t>& edges, const Array<double>& vertices_grad,
                    const std::array<double, 3>& spacing, double level, Array<T>& volume_grad, int num_threads) {
  const auto shape = shape_of_volume(volume);
  const std::int64_t num_vertices = check_points(vertices_grad, "vertices_grad");
  check_shape(edges, {num_vertices}, "edges");
  check_shape(volume_grad, {shape[0], shape[1], shape[2]}, "volume_grad");
  const py::gil_scoped_release nogil;
  marching_cubes_dense_backward(volume.data(), shape, edges.data(), vertices_grad.data(), num_vertices, spacing, level,
                                volume_grad.mutable_data(), num_threads);
}

ArrayTuple<std::int32_t, std::int32_t, std::int32_t> lattice(const Array<std::int32_t>& cells, int num_threads) {
  const std::int64_t num_cells = check_points(cells, "cells");
  SparseLattice result = without_gil([&] { return sparse_lattice(cells.data(), num_cells, num_threads); });
  return py::make_tuple(adopt(std::move(result.cells), {result.num_cells, 3}),
                        adopt(std::move(result.corners), {result.num_corners, 3}),
                        adopt(std::move(result.cell_corners), {result.num_cells, 8}));
}

ArrayTuple<std::int32_t, std::int64_t> components(const Array<std::int32_t>& faces, std::int64_t num_vertices) {
  const std::int64_t num_faces = check_points(faces, "faces");
  MeshComponents result = without_gil([&] { return mesh_components(faces.data(), num_faces, num_vertices); });
  return py::make_tuple(adopt(std::move(result.labels), {num_faces}),
                        py::array_t<std::int64_t>(static_cast<py::ssize_t>(result.sizes.size()), result.sizes.data()));
}

py::array_t<double> areas_of_vertices(const Array<double>& vertices, const Array<std::int32_t>& faces) {
  const std::int64_t num_vertices = check_points(vertices, "vertices"), num_faces = check_points(faces, "faces");
  Array<double> areas = new_array<double>(num_vertices);
  without_gil([&] { vertex_areas(vertices.data(), num_vertices, faces.data(), num_faces, areas.mutable_data()); });
  return areas;
}

Array<std::int32_t> near_surface(const VertexTable& table, const Array<float>& distances_m, float margin_m,
                                 int num_threads) {
  check_shape(distances_m, {table.num_rows()}, "distances_m");
  return to_array(without_gil([&] { return cells_near_surface(table, distances_m.data(), margin_m, num_threads); }));
}

ArrayTuple<double, std::int32_t> surface_of_grid(const VertexTable& table, const Array<float>& distances_m,
                                                 const Array<std::int32_t>& cells, int parts, double voxel_size,
                                                 const std::array<std::int32_t, 3>& lowest,
                                                 const std::array<std::int32_t, 3>& highest, int num_threads) {
  check_shape(distances_m, {table.num_rows()}, "distances_m");
  const std::int64_t num_cells = check_column(cells, "cells");
  return adopt_mesh(without_gil([&] {
    return grid_surface(table, distances_m.data(), cells.data(), num_cells, {parts, voxel_size, lowest, highest},
                        num_threads);
  }));
}

template <typename T>
void bind_for_type(py::module_& m) {
  using py::arg;
  const auto def_dense = [&m](const char* name, auto function) {
    m.def(name, function, "volume"_array, "mask"_array, arg("spacing"), arg("origin"), arg("level"),
          arg("num_threads") = 0);
  };
  def_dense("marching_cubes_dense", &dense<T>);
  def_dense("marching_cubes_dense_with_edges", &dense_with_edges<T>);
  m.def("marching_cubes_sparse", &sparse<T>, "corners"_array, "values"_array, "cells"_array, arg("spacing"),
        arg("origin"), arg("level"), arg("num_threads") = 0);
  m.def("marching_cubes_dense_backward", &dense_backward<T>, "volume"_array, "edges"_array, "vertices_grad"_array,
        arg("spacing"), arg("level"), "volume_grad"_array, arg("num_threads") = 0);
}

}  // namespace

void bind_surfaces(py::module_& m, VertexTableClass& table) {
  using py::arg;
  table.def(
      "cells_near_surface", &near_surface, "distances_m"_array, arg("margin_m"), arg("num_threads") = 0,
      "For an octree with `distances_m` (num_rows,) float32 at its corners, the rows (S,) int32 of the leaf cells "
      "with corners not all farther than `margin_m` from the surface, on the same side.");
  table.def("surface", &surface_of_grid, "distances_m"_array, "cells"_array, arg("parts"), arg("voxel_size"),
            arg("lowest"), arg("highest"), arg("num_threads") = 0,
            "Vertices (V, 3) float64, m, and faces (F, 3) int32 of the surface in the leaf cells with these rows (S,) "
            "int32, by trilinear interpolation at the corners of voxels: `parts` per edge of a leaf cell, with lattice "
            "coordinates from `lowest` to `highest`.");
  bind_for_type<float>(m);
  bind_for_type<double>(m);
  m.def("sparse_lattice", &lattice, "cells"_array, py::arg("num_threads") = 0);
  m.def("vertex_areas", &areas_of_vertices, "vertices"_array, "faces"_array,
        "A third of the area of the triangles (F, 3) at each vertex (V, 3): (V,) float64.");
  m.def("mesh_components", &components, "faces"_array, py::arg("num_vertices"));
}

}  // namespace radarsdf
