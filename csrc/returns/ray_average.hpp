// Average over rays of truncated signed distances at the vertices of an octree's leaf cells (Curless and Levoy 1996).
#pragma once

#include <cstdint>

#include "lattice/vertex_table.hpp"

namespace radarsdf {

struct AveragedRays {
  const float* points;      ///< (count, 3), end points, local frame, m
  const float* directions;  ///< (count, 3), unit, from the sensor
  const float* normals;     ///< (count, 3), of the surface there, unit, towards the sensor
  const float* weights;     ///< (count), integers, with a sum below 2^32 at a vertex
  std::int64_t count;
  std::uint32_t weight_of_return = 1;  ///< to which numbers of returns below refer
};

// Side of the surface on which a vertex certainly lies.
constexpr std::int8_t kInFront = 1, kBehind = -1;

// distances_m: (table.num_rows()), for each vertex of a leaf cell the mean of its signed distances, truncated at
// truncation_m, to the planes at the ends of the rays that cross one of its cells within truncation_m of their ends;
// a ray counts once for each of these cells. Vertices without rays, and rows of coarser levels, are 0.
// sides: (table.num_rows()), kInFront if at least 64 returns, and a quarter of those counted, have planes more than a
// leaf cell behind the vertex: rays passed it. kBehind if at least 512, and more than half, have planes more than a
// leaf cell in front of it, and hardly any behind it: occluded. 0 elsewhere. Results at a vertex depend only on the
// rays that reach it, to the last bit. Throws std::invalid_argument unless the table is an octree's.
void average_rays(const VertexTable& table, const AveragedRays& rays, double truncation_m, float* distances_m,
                  std::int8_t* sides, int num_threads);

}  // namespace radarsdf
