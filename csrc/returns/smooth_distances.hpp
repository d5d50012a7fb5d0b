// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Signed distances at the vertices of an octree's leaf cells that agree with the planes of returns, interpolated as the
// map interpolates them, and bend no more than they must: thin plates between what is known. A plate that bends must
// not cross zero where rays passed, nor where nothing was seen behind a surface.
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

// The surface at returns.
struct KnownPlanes {
  const float* points;       ///< (count, 3), local frame, m
  const float* normals;      ///< (count, 3), unit, towards the sensor
  const float* information;  ///< (count), 1 / variance of the plane's position, m^-2
  std::int64_t count;
};

// How far, in vertices along each axis, an iteration carries what is known.
constexpr int kSmoothingReach = 2;

// Moves distances_m, (table.num_rows()), towards the least sum of
//   information * (d - t)^2 / 3, over the three places of each plane a leaf cell behind, on and before it, where the
//   distance is t = -leaf, 0, leaf, and d is interpolated between the vertices of the cell that the place is in, and
//   (second difference / (2 leaf))^2, over all vertices and axes with a neighbour on both sides,
// by so many steps of Chebyshev's iteration, from what is there. The place behind a plane does not count in a cell with
// a plane that faces the other way: a wall may be thinner than a cell. Where sides, (table.num_rows()), of average_rays
// is not 0, a vertex stays at least a quarter of a leaf cell on that side. Rows of coarser levels stay. What a vertex
// gets depends, to the bit, on what is within kSmoothingReach * iterations vertices alone, and not on the number of
// threads. Throws std::invalid_argument for a table that is no octree's, or places without keys.
void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads);

}  // namespace radarsdf
