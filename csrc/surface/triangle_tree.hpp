// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The triangles of a mesh in a balanced tree of boxes.
#pragma once

#include <cstdint>

#include "util/large_array.hpp"

namespace radarsdf {

struct TreeTriangle {
  double corner[3];   // local frame, m
  float edges[2][3];  // from it to the other two, m
  float lengths[2];   // of these: sums of absolute coordinates
  std::int32_t face;
};

struct TreeBox {
  float low[3], high[3];  // m from `lower`, rounded outwards
};

// The tree is complete: box 1 holds all triangles, box i those of boxes 2 i and 2 i + 1, and box `leaves` + k those of
// leaf k, which begin at `first(k)`.
struct TriangleTree {
  // vertices: (num_vertices, 3), finite, m; faces: (num_faces, 3) rows of them. Throws std::invalid_argument.
  TriangleTree(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
               int num_threads);

  std::int64_t size() const { return static_cast<std::int64_t>(triangles.size()); }
  std::int64_t first(std::int64_t leaf) const { return size() * leaf / leaves; }
  std::int64_t num_bytes() const;

  double lower[3] = {};     // corner of box 1, local frame, m
  std::int64_t leaves = 0;  // a power of two, or none
  LargeVector<TreeBox> boxes;
  LargeVector<TreeTriangle> triangles;
};

}  // namespace radarsdf
