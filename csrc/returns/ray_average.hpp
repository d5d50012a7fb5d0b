// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The average, at the vertices of an octree's leaf cells, of what rays say of the distance to the surface, as truncated
// signed distance fields have it (Curless and Levoy 1996).
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

struct AveragedRays {
  const float* points;      ///< (count, 3), where they end, local frame, m
  const float* directions;  ///< (count, 3), unit, from the sensor
  const float* normals;     ///< (count, 3), of the surface there, unit, towards the sensor
  const float* weights;     ///< (count), whole numbers, fewer than 2^32 round a vertex
  std::int64_t count;
};

// Where a vertex lies for certain.
constexpr std::int8_t kInFront = 1, kBehind = -1;

// distances_m: (table.num_rows()), for each vertex of a leaf cell the mean of its signed distances to the planes at the
// ends of the rays that go, within truncation_m before and behind their ends, through one of its cells; each distance
// cut at truncation_m, and counted once for each of these cells. Vertices that no ray concerns, and rows of coarser
// levels, are 0.
// sides: (table.num_rows()), kInFront where at least 64 returns, and a quarter of those counted, have planes more than
// a leaf cell behind the vertex: rays passed it. kBehind where at least 512, and more than half, have planes more than
// a leaf cell in front of it, and hardly any behind it: nothing was seen there. 0 elsewhere. Only the rays that concern
// a vertex determine what it gets, to the bit. Throws std::invalid_argument for a table that is no octree's.
void average_rays(const VertexTable& table, const AveragedRays& rays, double truncation_m, float* distances_m,
                  std::int8_t* sides, int num_threads);

}  // namespace radarsdf
