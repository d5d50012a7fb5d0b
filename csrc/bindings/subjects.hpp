// One function for each subject, called by module.cpp. Kernels that use a table are methods of its class.
#pragma once

#include <pybind11/pybind11.h>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

using VertexTableClass = pybind11::class_<VertexTable>;

void bind_system(pybind11::module_& m);
void bind_cell_set(pybind11::module_& m);
VertexTableClass bind_vertex_table(pybind11::module_& m);
void bind_interpolation(VertexTableClass& table);
void bind_optimisers(pybind11::module_& m, VertexTableClass& table);
void bind_ray_average(VertexTableClass& table);
void bind_encodings(pybind11::module_& m);
void bind_mlp(pybind11::module_& m);
void bind_field_loss(pybind11::module_& m);
void bind_surfaces(pybind11::module_& m, VertexTableClass& table);
void bind_cell_means(pybind11::module_& m);
void bind_cell_sums(pybind11::module_& m);
void bind_growing_sums(pybind11::module_& m);
void bind_visibility(pybind11::module_& m);
void bind_free_space(pybind11::module_& m);
void bind_poses(pybind11::module_& m);
void bind_surface_crossings(pybind11::module_& m);
void bind_ray_tracing(pybind11::module_& m);

}  // namespace radarsdf
