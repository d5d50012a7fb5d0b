// The extractor that marching cubes on volumes, on lists of cells and on grids share: tasks count their vertices and
// faces, offsets in the mesh follow by sums, and tasks write from their offsets on.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <vector>

#include "surface/marching_cubes.hpp"
#include "surface/marching_cubes_table.hpp"
#include "util/large_array.hpp"
#include "util/vec3.hpp"

namespace radarsdf {

// Fraction of the edge from sample a to sample b at which the level is crossed; exactly one of them is > level.
inline double edge_fraction(double a, double b, double level) {
  double fraction = (level - a) / (b - a);
  // With an infinite sample, the crossing is at the other one; for an infinite b the division yields it.
  if (std::isinf(a)) fraction = std::isinf(b) ? 0.5 : 1.0;
  // In this order of arguments, a NaN, from an overflowing difference of samples, becomes the minimum.
  return std::max(min_edge_fraction, std::min(1 - min_edge_fraction, fraction));
}

// Writes the vertex on the edge from the sample at `index` along the axis, with the samples at its ends.
inline void write_vertex(const Lattice& lattice, const Vec3& index, int axis, double before, double after, double level,
                         double* vertex) {
  const double fraction = edge_fraction(before, after, level);
  constexpr double direction[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  for (int i = 0; i < 3; ++i) {
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

// Writes the triangles of a cell; returns the end. vertex_of(edge): of its cut edges.
template <typename VertexOf>
std::int32_t* write_triangles(const CellTriangles& cell, const VertexOf& vertex_of, std::int32_t* faces) {
  for (int n = 0; n < 3 * cell.num_triangles; ++n) *faces++ = vertex_of(cell.edges[n]);
  return faces;
}

// Numbers of vertices and faces of each task, at index task + 1; after sum_up, the offsets of its output.
struct MeshCounts {
  std::int64_t vertices = 0, faces = 0;
};

// Returns the mesh of the summed size.
inline Mesh sum_up(std::vector<MeshCounts>& counts, bool with_edges) {
  for (std::size_t i = 1; i < counts.size(); ++i) {
    counts[i].vertices += counts[i - 1].vertices;
    counts[i].faces += counts[i - 1].faces;
  }
  Mesh mesh;
  mesh.num_vertices = counts.back().vertices;
  mesh.num_faces = counts.back().faces;
  if (mesh.num_vertices > std::numeric_limits<std::int32_t>::max()) {
    throw std::invalid_argument("the mesh has more vertices than int32 faces can number: extract it in parts");
  }
  mesh.vertices = large_array<double>(3 * mesh.num_vertices);
  mesh.faces = large_array<std::int32_t>(3 * mesh.num_faces);
  if (with_edges) mesh.edges = large_array<std::int64_t>(mesh.num_vertices);
  return mesh;
}

}  // namespace radarsdf
