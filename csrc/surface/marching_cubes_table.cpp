// Two properties make the meshes closed and manifold, and the code below implements exactly these:
//  1. Where the surface crosses a cell's face depends on the four signs of that face alone, so the two cells that
//     share it draw the same segments. The segments chain into loops; each cut edge lies on exactly one of them.
//  2. No diagonal of a loop's triangulation joins two edges of one face. Two cells share nothing beyond a face, so
//     each diagonal belongs to one cell, and each mesh edge to two triangles.
#include "surface/marching_cubes_table.hpp"

#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "util/vec3.hpp"

namespace radarsdf {
namespace {

constexpr int num_edges = 12;
using Loop = std::vector<int>;  // edges, in order

int edge_between(int corner_a, int corner_b) {
  for (int edge = 0; edge < num_edges; ++edge) {
    const auto [corner, axis] = cell_edge(edge);
    if (corner == (corner_a & corner_b) && (corner | axis_bit(axis)) == (corner_a | corner_b)) return edge;
  }
  throw std::logic_error("two corners of a cell that no edge joins");
}

// Corners of a face, counter-clockwise seen from outside the cell.
std::array<int, 4> face_corners(int axis, bool upper) {
  const int u = axis_bit((axis + 1) % 3);
  const int v = axis_bit((axis + 2) % 3);
  const int side = upper ? axis_bit(axis) : 0;
  if (upper) return {side, side | u, side | u | v, side | v};
  return {side, side | v, side | u | v, side | u};
}

// Adds the segments on one face to `next`, which maps each cut edge to its successor in its loop. In the order of the
// corners, a segment starts where a run of positive corners ends and ends where that run starts, so the triangles face
// the positive side. On a face with two diagonally opposite positive corners this separates the positive corners, the
// rule of property 1.
void trace_face(int pattern, const std::array<int, 4>& corners, std::array<int, num_edges>& next) {
  const auto corner = [&](int i) { return corners[(i + 4) % 4]; };
  const auto positive = [&](int i) { return ((pattern >> corner(i)) & 1) != 0; };
  for (int i = 0; i < 4; ++i) {
    if (!positive(i) || positive(i + 1)) continue;
    int first = i;
    while (positive(first - 1)) --first;
    next[edge_between(corner(i), corner(i + 1))] = edge_between(corner(first - 1), corner(first));
  }
}

std::vector<Loop> trace_loops(int pattern) {
  std::array<int, num_edges> next{};
  next.fill(-1);
  for (int axis = 0; axis < 3; ++axis) {
    for (const bool upper : {false, true}) trace_face(pattern, face_corners(axis, upper), next);
  }
  std::vector<Loop> loops;
  for (int start = 0; start < num_edges; ++start) {
    Loop loop;
    for (int edge = start; next[edge] >= 0;) {
      loop.push_back(edge);
      edge = std::exchange(next[edge], -1);
    }
    if (!loop.empty()) loops.push_back(loop);
  }
  return loops;
}

bool share_face(int edge_a, int edge_b) {
  const CellEdge a = cell_edge(edge_a);
  const CellEdge b = cell_edge(edge_b);
  for (int axis = 0; axis < 3; ++axis) {
    const int bit = axis_bit(axis);
    if (a.axis != axis && b.axis != axis && (a.corner & bit) == (b.corner & bit)) return true;
  }
  return false;
}

Vec3 edge_middle(int edge) {
  const auto [corner, axis] = cell_edge(edge);
  Vec3 middle{static_cast<double>(corner >> 2), static_cast<double>(corner >> 1 & 1), static_cast<double>(corner & 1)};
  middle[axis] += 0.5;
  return middle;
}

// Deviation from an equilateral triangle: squared sides over area, infinite if degenerate.
double shape_cost(int edge_a, int edge_b, int edge_c) {
  const Vec3 a = edge_middle(edge_a), ab = edge_middle(edge_b) - a, ac = edge_middle(edge_c) - a;
  const double double_area = std::sqrt(dot(ab, ab) * dot(ac, ac) - dot(ab, ac) * dot(ab, ac));
  return (dot(ab, ab) + dot(ac, ac) - dot(ab, ac)) / double_area;  // |ab|²+|ac|²+|bc|² is twice the numerator
}

// Optimal triangulation of the part of a loop from `first` to `last`, closed by the line between them, over all choices
// of the third corner of the triangle at that line. An infinite cost means that property 2 allows none.
struct Triangulation {
  double cost = 0;
  std::vector<int> edges;
};

Triangulation triangulate(const Loop& loop, std::size_t first, std::size_t last) {
  if (last == first + 1) return {};
  Triangulation best{std::numeric_limits<double>::infinity(), {}};
  const bool is_diagonal = first != 0 || last + 1 != loop.size();
  if (is_diagonal && share_face(loop[first], loop[last])) return best;
  for (std::size_t third = first + 1; third < last; ++third) {
    Triangulation left = triangulate(loop, first, third);
    const Triangulation right = triangulate(loop, third, last);
    left.cost += right.cost + shape_cost(loop[first], loop[third], loop[last]);
    if (!(left.cost < best.cost)) continue;
    left.edges.insert(left.edges.end(), right.edges.begin(), right.edges.end());
    left.edges.insert(left.edges.end(), {loop[first], loop[third], loop[last]});
    best = std::move(left);
  }
  return best;
}

CellTriangles build_case(int pattern) {
  CellTriangles result;
  std::size_t used = 0;
  for (const Loop& loop : trace_loops(pattern)) {
    const Triangulation triangulation = triangulate(loop, 0, loop.size() - 1);
    if (std::isinf(triangulation.cost)) throw std::logic_error("a loop of marching cubes without triangulation");
    for (const int edge : loop) result.cut_edges = static_cast<std::uint16_t>(result.cut_edges | 1 << edge);
    for (const int edge : triangulation.edges) result.edges.at(used++) = static_cast<std::uint8_t>(edge);
  }
  result.num_triangles = static_cast<std::uint8_t>(used / 3);
  return result;
}

}  // namespace

const MarchingCubesTable& marching_cubes_table() {
  static const MarchingCubesTable table = [] {
    MarchingCubesTable result;
    for (std::size_t pattern = 0; pattern < result.size(); ++pattern) {
      result[pattern] = build_case(static_cast<int>(pattern));
    }
    return result;
  }();
  return table;
}

}  // namespace radarsdf
