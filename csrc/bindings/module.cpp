// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Table of contents of the compiled core. Each subject has its own file; the core itself knows no Python.
#include <pybind11/pybind11.h>

namespace py = pybind11;

namespace radarsdf {
void bind_marching_cubes(py::module_& m);
}

PYBIND11_MODULE(_core, m, py::mod_gil_not_used()) {
  m.doc() = "Compiled core of radarsdf: private, use the functions of the package.";
  radarsdf::bind_marching_cubes(m);
}
