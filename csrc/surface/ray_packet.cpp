#include "surface/ray_packet.hpp"

#include <algorithm>
#include <cmath>

#include "util/integers.hpp"

namespace radarsdf {
namespace {

constexpr int kRays = RayPacket::kRays;
constexpr int kStack = 64;                 // boxes: more than the depth of the tree
constexpr float kLeastDirection = 1e-30F;  // component along an axis: its reciprocal is finite
constexpr float kBoxSlack = 1 + 2e-5F;     // factor of the exit range of a box: no hit is lost by rounding
// Rays this close to an edge hit it, so that none passes between two triangles. With a third of it, none of 10^7 rays
// aimed at edges did.
constexpr float kEdgeSlack_rad = 1e-7F;
constexpr float kLeastSlope = 1e-6F;  // between ray and plane: triangles seen edge-on are not hit

// Compilers vectorise these, but not std::min, which returns a reference.
inline float least(float a, float b) { return a < b ? a : b; }
inline float most(float a, float b) { return a > b ? a : b; }

using Directions = float[3][kRays];

// Whether any ray enters a box before its hit. low, high: relative to the origin, m.
bool any_through(const RayPacket& packet, const Directions& inverse, const float* low, const float* high) {
  int any = 0;
  for (int i = 0; i < kRays; ++i) {
    float enter_m = 0, leave_m = packet.ranges_m[i];
    for (int axis = 0; axis < 3; ++axis) {
      const float a = low[axis] * inverse[axis][i], b = high[axis] * inverse[axis][i];
      enter_m = most(enter_m, least(a, b));
      leave_m = least(leave_m, most(a, b));
    }
    any |= enter_m <= leave_m * kBoxSlack;
  }
  return any != 0;
}

// Moeller and Trumbore 1997; terms independent of the direction are shared by the rays.
void meet(const TreeTriangle& triangle, std::int32_t row, const double* origin, bool front_only, RayPacket& packet) {
  const float *a = triangle.edges[0], *b = triangle.edges[1];
  float corner[3], normal[3], across_a[3], across_b[3], distance = 0, length = 0;
  double height = 0;  // height of the origin above the triangle's plane, times the length of `normal`
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3, last = (axis + 2) % 3;
    const double from_origin = triangle.corner[axis] - origin[axis];
    const double across = double{a[next]} * double{b[last]} - double{a[last]} * double{b[next]};
    height -= across * from_origin;
    corner[axis] = static_cast<float>(from_origin);
    normal[axis] = static_cast<float>(across);
    distance += std::abs(corner[axis]);
    length += std::abs(normal[axis]);
  }
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3, last = (axis + 2) % 3;
    across_a[axis] = a[next] * corner[last] - a[last] * corner[next];
    across_b[axis] = corner[next] * b[last] - corner[last] * b[next];
  }
  const float slack_m = kEdgeSlack_rad * distance, least_slope = kLeastSlope * length;
  const float least_u = -slack_m * triangle.lengths[1], least_v = -slack_m * triangle.lengths[0];
  for (const float side : {1.0F, -1.0F}) {  // both if the origin lies in the plane
    const float above = side * static_cast<float>(height);
    if (!(above >= 0) || (front_only && side < 0)) continue;
    int met[kRays], any = 0;
    float slopes[kRays];
    for (int i = 0; i < kRays; ++i) {
      const float x = side * packet.directions[0][i], y = side * packet.directions[1][i],
                  z = side * packet.directions[2][i];
      const float slope = -(x * normal[0] + y * normal[1] + z * normal[2]);
      const float u = x * across_b[0] + y * across_b[1] + z * across_b[2];
      const float v = x * across_a[0] + y * across_a[1] + z * across_a[2];
      const int inside = (u >= least_u) & (v >= least_v) & (u + v <= slope - least_u - least_v);
      met[i] = inside & (slope > least_slope) & (above < packet.ranges_m[i] * slope);
      slopes[i] = slope;
      any |= met[i];
    }
    if (any == 0) continue;
    for (int i = 0; i < kRays; ++i) {
      packet.ranges_m[i] = met[i] != 0 ? above / slopes[i] : packet.ranges_m[i];
      packet.triangles[i] = met[i] != 0 ? row : packet.triangles[i];
    }
  }
}

}  // namespace

void trace(const TriangleTree& tree, const double* origin, bool front_only, RayPacket& packet) {
  Directions inverse;
  float towards[3] = {};
  double lower[3];  // lower bound of the tree, relative to the origin
  for (int axis = 0; axis < 3; ++axis) {
    lower[axis] = tree.lower[axis] - origin[axis];
    for (int i = 0; i < kRays; ++i) {
      const float direction = packet.directions[axis][i];
      inverse[axis][i] = 1 / (std::abs(direction) < kLeastDirection ? kLeastDirection : direction);
      towards[axis] += direction;
    }
  }
  int64_t stack[kStack] = {1}, size = 1;
  while (size > 0) {
    const int64_t i = stack[--size];
    const TreeBox& box = tree.boxes[i];
    float low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = static_cast<float>(lower[axis] + double{box.low[axis]});
      high[axis] = static_cast<float>(lower[axis] + double{box.high[axis]});
    }
    if (!any_through(packet, inverse, low, high)) continue;
    if (i >= tree.leaves) {
      const int64_t leaf = i - tree.leaves;
      for (int64_t row = tree.first(leaf); row < tree.first(leaf + 1); ++row) {
        meet(tree.triangles[row], static_cast<std::int32_t>(row), origin, front_only, packet);
      }
      continue;
    }
    const TreeBox *left = &tree.boxes[2 * i], *right = left + 1;
    float way = 0;  // from the left to the right box, along the rays
    for (int axis = 0; axis < 3; ++axis) {
      way += towards[axis] * (right->low[axis] + right->high[axis] - left->low[axis] - left->high[axis]);
    }
    const int64_t nearer = way < 0 ? 1 : 0;
    stack[size++] = 2 * i + 1 - nearer;
    stack[size++] = 2 * i + nearer;
  }
}

}  // namespace radarsdf
