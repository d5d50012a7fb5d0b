#include "surface/triangle_tree.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "surface/mesh_components.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int64_t kLeafTriangles = 4;  // maximum
constexpr int64_t kMinBlock = 1 << 10;
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr TreeBox kNothing{{kInfinity, kInfinity, kInfinity}, {-kInfinity, -kInfinity, -kInfinity}};

struct Centre {
  float at[3];  // sum of the corners, m, relative to the tree's `lower`
  int32_t face;
};

// Axis of the largest extent of centres.
int widest_axis(const Centre* begin, const Centre* end) {
  TreeBox box = kNothing;
  for (const Centre* centre = begin; centre != end; ++centre) {
    for (int axis = 0; axis < 3; ++axis) {
      box.low[axis] = std::min(box.low[axis], centre->at[axis]);
      box.high[axis] = std::max(box.high[axis], centre->at[axis]);
    }
  }
  int widest = 0;
  for (int axis = 1; axis < 3; ++axis) {
    if (box.high[axis] - box.low[axis] > box.high[widest] - box.low[widest]) widest = axis;
  }
  return widest;
}

}  // namespace

TriangleTree::TriangleTree(const double* vertices, int64_t num_vertices, const int32_t* faces, int64_t num_faces,
                           int num_threads) {
  check_faces(faces, num_faces, num_vertices);
  for (int64_t i = 0; i < 3 * num_vertices; ++i) {
    if (!std::isfinite(vertices[i])) throw std::invalid_argument("vertices must be finite");
  }
  if (num_faces == 0) return;
  const auto vertex = [&](int64_t face, int64_t corner) { return vertices + 3 * int64_t{faces[3 * face + corner]}; };
  std::copy_n(vertex(0, 0), 3, lower);
  for (int64_t i = 0; i < 3 * num_faces; ++i) {
    for (int axis = 0; axis < 3; ++axis) lower[axis] = std::min(lower[axis], vertex(0, i)[axis]);
  }

  LargeVector<Centre> centres(num_faces);
  parallel_for(num_faces, kMinBlock, num_threads, [&](int64_t face) {
    Centre& centre = centres[face];
    centre.face = static_cast<int32_t>(face);
    for (int axis = 0; axis < 3; ++axis) {
      double sum = 0;
      for (int corner = 0; corner < 3; ++corner) sum += vertex(face, corner)[axis] - lower[axis];
      centre.at[axis] = static_cast<float>(sum);
    }
  });
  leaves = 1;
  for (; leaves * kLeafTriangles < num_faces; leaves *= 2) {
    parallel_tasks(leaves, num_threads, [&](int64_t i) {  // halves each part at the median
      const auto at = [&](int64_t half) { return centres.data() + num_faces * half / (2 * leaves); };
      const int axis = widest_axis(at(2 * i), at(2 * i + 2));
      std::nth_element(at(2 * i), at(2 * i + 1), at(2 * i + 2),
                       [&](const Centre& a, const Centre& b) { return a.at[axis] < b.at[axis]; });
    });
  }

  triangles.resize(num_faces);
  boxes.assign(2 * leaves, kNothing);
  parallel_for(leaves, kMinBlock, num_threads, [&](int64_t leaf) {
    TreeBox& box = boxes[leaves + leaf];
    for (int64_t row = first(leaf); row < first(leaf + 1); ++row) {
      const int32_t face = centres[row].face;
      const double* corners[3] = {vertex(face, 0), vertex(face, 1), vertex(face, 2)};
      TreeTriangle& triangle = triangles[row];
      triangle.face = face;
      triangle.lengths[0] = triangle.lengths[1] = 0;
      for (int axis = 0; axis < 3; ++axis) {
        triangle.corner[axis] = corners[0][axis];
        for (int edge = 0; edge < 2; ++edge) {
          triangle.edges[edge][axis] = static_cast<float>(corners[edge + 1][axis] - corners[0][axis]);
          triangle.lengths[edge] += std::abs(triangle.edges[edge][axis]);
        }
        const auto [low, high] = std::minmax({corners[0][axis], corners[1][axis], corners[2][axis]});
        const auto low_m = static_cast<float>(low - lower[axis]), high_m = static_cast<float>(high - lower[axis]);
        box.low[axis] = std::min(box.low[axis], std::nextafter(low_m, -kInfinity));
        box.high[axis] = std::max(box.high[axis], std::nextafter(high_m, kInfinity));
      }
    }
  });
  for (auto i = static_cast<size_t>(leaves); --i > 0;) {
    for (int axis = 0; axis < 3; ++axis) {
      boxes[i].low[axis] = std::min(boxes[2 * i].low[axis], boxes[2 * i + 1].low[axis]);
      boxes[i].high[axis] = std::max(boxes[2 * i].high[axis], boxes[2 * i + 1].high[axis]);
    }
  }
}

int64_t TriangleTree::num_bytes() const {
  return static_cast<int64_t>(boxes.size() * sizeof(TreeBox) + triangles.size() * sizeof(TreeTriangle));
}

}  // namespace radarsdf
