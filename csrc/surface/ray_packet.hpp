// Packets of rays that traverse a tree of triangles together. Loops over the rays are vectorised, and coherent rays
// mostly visit the same nodes.
#pragma once

#include <cstdint>

#include "surface/triangle_tree.hpp"

namespace radarsdf {

struct RayPacket {
  static constexpr int kRays = 16;

  float directions[3][kRays];
  float ranges_m[kRays];          // in: maximum range; out: approximate range of the hit
  std::int32_t triangles[kRays];  // row in the tree of the triangle hit; unchanged without a hit
};

// origin: (3), of all rays, local frame, m.
void trace(const TriangleTree& tree, const double* origin, bool front_only, RayPacket& packet);

}  // namespace radarsdf
