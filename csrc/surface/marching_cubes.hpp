// Marching cubes on a dense volume and on a list of cells, with identical meshes for identical samples:
//  - a sample is positive iff it is > level; triangles face the positive side (in this project: free space);
//  - one vertex per cut edge of the cells in use, so the mesh is closed and manifold except at their border;
//  - vertices keep a distance of min_edge_fraction of an edge from the samples, so vertices of different edges never
//    coincide and no triangle is degenerate, even where samples equal the level;
//  - a cell with a NaN corner is not in use; of infinite samples only the sign matters.
// The order of vertices and faces depends on the data alone, not on the number of threads.
#pragma once

#include <array>
#include <cstdint>
#include <memory>

namespace radarsdf {

constexpr double min_edge_fraction = 1e-3;

struct Mesh {
  std::int64_t num_vertices = 0;
  std::int64_t num_faces = 0;
  std::unique_ptr<double[]> vertices;     ///< (num_vertices, 3), world units
  std::unique_ptr<std::int32_t[]> faces;  ///< (num_faces, 3) rows of vertices
  // The edge of each vertex, for the derivatives below. Null unless requested from dense marching cubes.
  std::unique_ptr<std::int64_t[]> edges;  ///< (num_vertices,) 3 * sample + axis: the edge's lower sample, its axis
};

// Placement of the samples: sample (i, j, k) is at origin + spacing * (i, j, k).
struct Lattice {
  std::array<double, 3> spacing{1, 1, 1};  ///< world units, finite and > 0
  std::array<double, 3> origin{0, 0, 0};   ///< world units, finite
};

// volume: shape[0] * shape[1] * shape[2] samples in C order. mask: null, or as many flags, true for valid samples; a
// cell needs all eight corners. T is float or double.
template <typename T>
Mesh marching_cubes_dense(const T* volume, const std::array<std::int64_t, 3>& shape, const bool* mask,
                          const Lattice& lattice, double level, int num_threads, bool with_edges = false);

// corners: (num_corners, 3) lattice coordinates, each at most once; values: one per corner; cells: (num_cells, 8) rows
// of corners in the order of marching_cubes_table.hpp, each cell at most once. T is float or double.
template <typename T>
Mesh marching_cubes_sparse(const std::int32_t* corners, const T* values, std::int64_t num_corners,
                           const std::int32_t* cells, std::int64_t num_cells, const Lattice& lattice, double level,
                           int num_threads);

// Backward pass: volume_grad (shape) from vertices_grad (num_vertices, 3) and the edges of the mesh. A vertex moves
// only along its edge, and not at all where it is clamped away from a sample, or where a sample is infinite.
template <typename T>
void marching_cubes_dense_backward(const T* volume, const std::array<std::int64_t, 3>& shape, const std::int64_t* edges,
                                   const double* vertices_grad, std::int64_t num_vertices,
                                   const std::array<double, 3>& spacing, double level, T* volume_grad, int num_threads);

}  // namespace radarsdf
