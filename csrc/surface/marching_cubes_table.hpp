// Triangles of a cell for each of the 256 sign patterns of its corners.
//
// Corners are numbered in the C order of a 2x2x2 block: corner c sits at (c >> 2, (c >> 1) & 1, c & 1), which is the
// order of volume[i:i+2, j:j+2, k:k+2].ravel(). Bit c of a pattern is set where corner c is positive.
// Edges are numbered by axis, then by lower corner: edge_corner and edge_axis below.
#pragma once

#include <array>
#include <cstdint>

namespace radarsdf {

struct CellEdge {
  int corner;  ///< the lower end along the axis
  int axis;    ///< 0, 1, 2 for x, y, z
};

// The bit of a corner number for its side along the axis.
constexpr int axis_bit(int axis) { return 4 >> axis; }

constexpr CellEdge cell_edge(int edge) {
  const int axis = edge / 4;
  const int rest = edge % 4;             // the corner's other two bits: those below the axis's bit stay,
  const int below = axis_bit(axis) - 1;  // those above it move up by one
  return {(rest & ~below) << 1 | (rest & below), axis};
}

struct CellTriangles {
  static constexpr int max_triangles = 5;  // the builder checks it
  std::uint16_t cut_edges = 0;             ///< bit e is set if the ends of edge e differ in sign
  std::uint8_t num_triangles = 0;
  std::array<std::uint8_t, 3 * max_triangles> edges{};  ///< three edges per triangle; its normal points to the positive
};

using MarchingCubesTable = std::array<CellTriangles, 256>;

// Built at the first call (well under a millisecond); thread-safe.
const MarchingCubesTable& marching_cubes_table();

}  // namespace radarsdf
