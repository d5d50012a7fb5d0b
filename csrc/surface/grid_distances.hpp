// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What a mesh needs of a grid of distances: them at the corners of voxels that divide its cells, and the areas of the
// triangles at each vertex.
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

// found_m: (num_corners), distances_m, (table.num_rows()), of an octree, interpolated trilinearly at the corners,
// (num_corners, 3), of voxels of which `parts` make the edge of a leaf cell: corner i lies at i / parts leaf cells. On
// the border of several cells any one of them gives the same bits. NaN in no cell. Throws std::invalid_argument.
void grid_distances(const VertexTable& table, const float* distances_m, const std::int32_t* corners,
                    std::int64_t num_corners, int parts, float* found_m, int num_threads);

// areas: (num_vertices), a third of the areas of the triangles, (num_faces, 3), at each vertex, (num_vertices, 3).
// Throws std::invalid_argument for a face with a vertex that does not exist.
void vertex_areas(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                  double* areas);

}  // namespace radarsdf
