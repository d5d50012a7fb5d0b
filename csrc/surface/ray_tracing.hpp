// First hits of rays on a triangle mesh. Rays are sorted by direction, and traverse the tree of triangles in packets.
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

  // For each ray the distance to the first hit, m, or infinity, and the row of its triangle, or -1. origin: (3), of all
  // rays; directions: (count, 3) unit vectors. front_only: only triangles seen from the front, with counter-clockwise
  // corners, are hit. Throws std::invalid_argument.
  void first_hits(const double* origin, const float* directions, std::int64_t count, double max_range_m,
                  bool front_only, float* ranges_m, std::int32_t* faces, int num_threads) const;

  std::int64_t num_bytes() const { return tree_.num_bytes(); }

 private:
  TriangleTree tree_;
};

}  // namespace radarsdf
