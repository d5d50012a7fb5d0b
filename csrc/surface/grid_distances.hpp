// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Helpers of mesh extraction from a grid of distances: interpolation at the corners of voxels that subdivide its cells,
// and areas of triangles by vertex.
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

// found_m: (num_corners), trilinear interpolation of distances_m (table.num_rows()) of an octree at the corners
// (num_corners, 3) of voxels, `parts` along the edge of a leaf cell: corner i lies at i / parts leaf cells. On the
// border of several cells, all give the same bits. NaN outside the cells. Throws std::invalid_argument.
void grid_distances(const VertexTable& table, const float* distances_m, const std::int32_t* corners,
                    std::int64_t num_corners, int parts, float* found_m, int num_threads);

// areas: (num_vertices), a third of the area of the incident triangles (num_faces, 3) of each vertex (num_vertices, 3).
// Throws std::invalid_argument for a face with a vertex out of range.
void vertex_areas(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                  double* areas);

}  // namespace radarsdf
