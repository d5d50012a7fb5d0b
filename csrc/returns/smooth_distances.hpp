// Thin-plate smoothing of signed distances at the vertices of an octree's leaf cells: they agree with the planes of
// returns, interpolated as in the map, and minimise bending in between. Zero crossings are excluded where rays passed,
// and in occluded space behind surfaces.
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

// Planes at returns.
struct KnownPlanes {
  const float* points;       ///< (count, 3), local frame, m
  const float* normals;      ///< (count, 3), unit, towards the sensor
  const float* information;  ///< (count), 1 / variance of the plane's position, m^-2
  std::int64_t count;
};

// Reach of an iteration along each axis, vertices.
constexpr int kSmoothingReach = 2;

// Moves distances_m (table.num_rows()) towards the minimum of the sum of
//   information * (d - t)^2 / 3, over three places for each plane, a leaf cell behind, on and before it, with the
//   target t = -leaf, 0, leaf, and d interpolated between the vertices of the cell that contains the place, and
//   (second difference / (2 leaf))^2, over all vertices and axes with a neighbour on both sides,
// by this number of Chebyshev iterations from the initial values. The place behind a plane is ignored in a cell with an
// opposite plane: a wall may be thinner than a cell. Where `sides` (table.num_rows()) of average_rays is not 0, a
// vertex stays on that side by at least a quarter of a leaf cell. Rows of coarser levels are not changed. Results
// depend, to the last bit, only on vertices within kSmoothingReach * iterations, and not on the number of threads.
// Throws std::invalid_argument unless the table is an octree's and all places have keys.
void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads);

}  // namespace radarsdf
