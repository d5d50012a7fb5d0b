// Marching cubes on the distances at the corners of leaf cells, in voxels that divide these cells evenly: the mesh of
// marching_cubes_sparse on trilinear interpolation, without a lattice of voxels.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "lattice/vertex_table.hpp"
#include "surface/marching_cubes.hpp"

namespace radarsdf {

// Rows of the leaf cells of an octree with corners, by distances_m (table.num_rows()), not all farther than margin_m
// from the surface, on the same side. Interpolation keeps within the corners: others hold no surface. Throws
// std::invalid_argument.
std::vector<std::int32_t> cells_near_surface(const VertexTable& table, const float* distances_m, float margin_m,
                                             int num_threads);

struct GridVoxels {
  int parts;                                    // per edge of a leaf cell
  double size_m;                                // edge
  std::array<std::int32_t, 3> lowest, highest;  // lattice coordinates of the voxels to use
};

// Surface in some leaf cells, by ascending row; cells with a NaN have none. Vertices are ordered by the vertex of a
// leaf cell at or below the lower end of their edge. Throws std::invalid_argument.
Mesh grid_surface(const VertexTable& table, const float* distances_m, const std::int32_t* cells, std::int64_t num_cells,
                  const GridVoxels& voxels, int num_threads);

}  // namespace radarsdf
