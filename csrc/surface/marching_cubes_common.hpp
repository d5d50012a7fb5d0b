// Shared code of dense and sparse marching cubes: cuts of edges, checks, allocation of the result.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>

#include "surface/marching_cubes.hpp"
#include "util/large_array.hpp"

namespace radarsdf {

// Fraction of the edge from sample a to sample b at which the level is crossed; exactly one of them is > level.
inline double edge_fraction(double a, double b, double level) {
  double fraction = (level - a) / (b - a);
  // With an infinite sample, the crossing is at the other one; for an infinite b the division yields it.
  if (std::isinf(a)) fraction = std::isinf(b) ? 0.5 : 1.0;
  // In this order of arguments, a NaN, from an overflowing difference of samples, becomes the minimum.
  return std::max(min_edge_fraction, std::min(1 - min_edge_fraction, fraction));
}

inline void write_vertex(const Lattice& lattice, const std::array<double, 3>& index, std::size_t axis, double fraction,
                         double* vertex) {
  constexpr double direction[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (std::size_t i = 0; i < 3; ++i) {
    vertex[i] = (index[i] + fraction * direction[axis][i]) * lattice.spacing[i] + lattice.origin[i];
  }
}

inline void check_lattice(const Lattice& lattice, double level) {
  for (std::size_t i = 0; i < 3; ++i) {
    if (!(std::isfinite(lattice.spacing[i]) && lattice.spacing[i] > 0)) {
      throw std::invalid_argument("spacing must be finite and positive");
    }
    if (!std::isfinite(lattice.origin[i])) throw std::invalid_argument("origin must be finite");
  }
  if (!std::isfinite(level)) throw std::invalid_argument("level must be finite");
}

inline Mesh allocate_mesh(std::int64_t num_vertices, std::int64_t num_faces, bool with_edges) {
  if (num_vertices > std::numeric_limits<std::int32_t>::max()) {
    throw std::invalid_argument("the mesh has more vertices than int32 faces can number: extract it in parts");
  }
  Mesh mesh;
  mesh.num_vertices = num_vertices;
  mesh.num_faces = num_faces;
  mesh.vertices = large_array<double>(3 * num_vertices);
  mesh.faces = large_array<std::int32_t>(3 * num_faces);
  if (with_edges) mesh.edges = large_array<std::int64_t>(num_vertices);
  return mesh;
}

}  // namespace radarsdf
