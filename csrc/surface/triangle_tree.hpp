// Balanced bounding-box tree of the triangles of a mesh.
#pragma once

#include <cstdint>

#include "util/large_array.hpp"

namespace radarsdf {

struct TreeTriangle {
  double corner[3];   // local frame, m
  float edges[2][3];  // from it to the other two, m
  float lengths[2];   // their L1 norms
  std::int32_t face;
};

struct TreeBox {
  float low[3], high[3];  // m from `lower`, rounded outwards
};

// Complete binary tree: box 1 is the root, boxes 2 i and 2 i + 1 are the children of box i, and box `leaves` + k holds
// the triangles of leaf k, from `first(k)` on.
struct TriangleTree {
  // vertices: (num_vertices, 3), finite, m; faces: (num_faces, 3) rows of them. Throws std::invalid_argument.
  TriangleTree(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
               int num_threads);

  std::int64_t size() const { return static_cast<std::int64_t>(triangles.size()); }
  std::int64_t first(std::int64_t leaf) const { return size() * leaf / leaves; }
  std::int64_t num_bytes() const;

  double lower[3] = {};     // corner of box 1, local frame, m
  std::int64_t leaves = 0;  // a power of two, or 0
  LargeVector<TreeBox> boxes;
  LargeVector<TreeTriangle> triangles;
};

}  // namespace radarsdf
