// Table of contents of the Python bindings. Each subject has its own file; the core itself is independent of Python.
#include "bindings/subjects.hpp"

PYBIND11_MODULE(_core, m, pybind11::mod_gil_not_used()) {
  m.doc() = "Compiled core of radarsdf. Private: use the functions of the package.";
  radarsdf::bind_system(m);
  radarsdf::bind_cell_set(m);
  radarsdf::VertexTableClass table = radarsdf::bind_vertex_table(m);
  radarsdf::bind_interpolation(table);
  radarsdf::bind_optimisers(m, table);
  radarsdf::bind_ray_average(table);
  radarsdf::bind_encodings(m);
  radarsdf::bind_mlp(m);
  radarsdf::bind_field_loss(m);
  radarsdf::bind_surfaces(m, table);
  radarsdf::bind_cell_means(m);
  radarsdf::bind_cell_sums(m);
  radarsdf::bind_growing_sums(m);
  radarsdf::bind_visibility(m);
  radarsdf::bind_free_space(m);
  radarsdf::bind_poses(m);
  radarsdf::bind_surface_crossings(m);
  radarsdf::bind_ray_tracing(m);
}
