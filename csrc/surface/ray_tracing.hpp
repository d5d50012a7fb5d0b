// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Where rays first meet a triangle mesh. They are sorted by direction, and neighbours go through the tree of its
// triangles together.
#pragma once

#include <cstdint>

#include "surface/triangle_tree.hpp"

namespace radarsdf {

class SurfaceTracer {
 public:
  // See TriangleTree.
  SurfaceTracer(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                int num_threads)
      : tree_(vertices, num_vertices, faces, num_faces, num_threads) {}

  // For each ray the distance to the first triangle, m, infinite without one, and the triangle's row, -1 without one.
  // origin: (3), that of all rays; directions: (count, 3) unit vectors. Both sides of a triangle stop a ray, or the
  // front alone: the side from which its corners are counter-clockwise. Throws std::invalid_argument.
  void first_hits(const double* origin, const float* directions, std::int64_t count, double max_range_m,
                  bool front_only, float* ranges_m, std::int32_t* faces, int num_threads) const;

  std::int64_t num_bytes() const { return tree_.num_bytes(); }

 private:
  TriangleTree tree_;
};

}  // namespace radarsdf
