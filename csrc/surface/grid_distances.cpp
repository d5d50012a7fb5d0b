// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "surface/grid_distances.hpp"

#include <cmath>
#include <limits>
#include <stdexcept>

#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kCorners = 1 << 13;  // minimum per thread

// Linear interpolation, exact at both ends, so that cells agree on common faces.
inline float between(float before, float after, float share) { return (1 - share) * before + share * after; }

}  // namespace

void grid_distances(const VertexTable& table, const float* distances_m, const std::int32_t* corners,
                    std::int64_t num_corners, int parts, float* found_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  if (parts < 1) throw std::invalid_argument("parts must be at least 1");
  parallel_blocks(num_corners, kCorners, num_threads, [&](std::int64_t begin, std::int64_t end) {
    NearbyRows rows(table.leaves());
    // State of the previous corner: sorted corners mostly share coordinates with it.
    std::int32_t last[3] = {}, cell[3] = {};
    int part[3] = {};
    float upper[3] = {};
    std::uint64_t keys[3][2] = {};  // key bits by axis, of the cell and of the previous one
    for (std::int64_t i = begin; i < end; ++i) {
      int on_border = 0;  // bit `axis`: the previous cell has the corner, too
      bool is_near = true;
      for (int axis = 0; axis < 3; ++axis) {
        const std::int32_t corner = corners[3 * i + axis];
        if (i == begin || corner != last[axis]) {
          last[axis] = corner;
          cell[axis] = corner / parts - (corner % parts < 0 ? 1 : 0);
          part[axis] = corner - cell[axis] * parts;
          upper[axis] = static_cast<float>(part[axis]) / static_cast<float>(parts);
          for (std::uint32_t k = 0; k < 2; ++k)
            keys[axis][k] = spread_bits(static_cast<std::uint32_t>(cell[axis]) + kAxisBias - k) << axis;
        }
        if (part[axis] == 0) on_border |= 1 << axis;
        is_near = is_near && cell[axis] > -kAxisBias && cell[axis] < kAxisBias;
      }
      std::int32_t row = -1;
      int before = -1;
      while (is_near && row < 0 && ++before < 8) {
        if ((before & ~on_border) != 0) continue;
        row = rows.row(keys[0][before & 1] | keys[1][before >> 1 & 1] | keys[2][before >> 2]);
      }
      if (row < 0) {
        found_m[i] = std::numeric_limits<float>::quiet_NaN();
        continue;
      }
      const std::int32_t* vertices = table.cells()[static_cast<std::size_t>(row)].rows;
      float values[8], share[3];
      for (int c = 0; c < 8; ++c) values[c] = distances_m[vertices[c]];
      for (int axis = 0; axis < 3; ++axis) share[axis] = (before >> axis & 1) != 0 ? 1 : upper[axis];
      for (int axis = 0; axis < 3; ++axis)
        for (int c = 0; c < 4 >> axis; ++c) values[c] = between(values[2 * c], values[2 * c + 1], share[axis]);
      found_m[i] = values[0];
    }
  });
}

void vertex_areas(const double* vertices, std::int64_t num_vertices, const std::int32_t* faces, std::int64_t num_faces,
                  double* areas) {
  for (std::int64_t v = 0; v < num_vertices; ++v) areas[v] = 0;
  for (std::int64_t f = 0; f < num_faces; ++f) {
    if (f % (1 << 18) == 0) check_interrupt();
    const double* corners[3];
    for (int c = 0; c < 3; ++c) {
      const std::int32_t v = faces[3 * f + c];
      if (v < 0 || v >= num_vertices) throw std::invalid_argument("a face refers to a vertex that does not exist");
      corners[c] = vertices + 3 * std::int64_t{v};
    }
    double a[3], b[3];
    for (int axis = 0; axis < 3; ++axis) {
      a[axis] = corners[1][axis] - corners[0][axis];
      b[axis] = corners[2][axis] - corners[0][axis];
    }
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    const double sixth = std::sqrt(x * x + y * y + z * z) / 6;
    for (int c = 0; c < 3; ++c) areas[faces[3 * f + c]] += sixth;
  }
}

}  // namespace radarsdf
