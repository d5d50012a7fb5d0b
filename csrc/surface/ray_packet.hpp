// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Rays that go through a tree of triangles together. Loops over the rays are vectors of the processor, and what one ray
// passes, most of them pass, if they go about the same way.
#pragma once

#include <cstdint>

#include "surface/triangle_tree.hpp"

namespace radarsdf {

struct RayPacket {
  static constexpr int kRays = 16;

  float directions[3][kRays];
  float ranges_m[kRays];          // before: the farthest that counts; after: of the hit, about
  std::int32_t triangles[kRays];  // row in the tree of the triangle that is hit; unchanged without one
};

// The rays begin at `origin` (3), local frame, m.
void trace(const TriangleTree& tree, const double* origin, bool front_only, RayPacket& packet);

}  // namespace radarsdf
