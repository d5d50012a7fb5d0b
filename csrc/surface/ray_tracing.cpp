// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "surface/ray_tracing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

using std::int32_t;
using std::int64_t;
using std::size_t;

constexpr int64_t kEdge = 4;                      // cells along the edge of a block
constexpr int64_t kMaxBlocks = int64_t{1} << 24;  // of 8 bytes each
constexpr int64_t kMaxEntries = int64_t{1} << 31;
// Of a cell: a triangle is also listed in cells that it comes as near to, so rounding cannot hide it from a ray that
// meets it on the face of two cells.
constexpr double kSlack = 1e-3;
constexpr float kEdgeSlack = 1e-5F;  // of a triangle's edge: no ray slips through between two of them
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr std::uint16_t kMaxGap = 1 << 15;

struct Box {
  int64_t low[3], high[3];  // cells, both inclusive
};

// Whether the plane of a triangle comes within the slack of a cell.
struct PlaneOfTriangle {
  PlaneOfTriangle(const double (&corner)[3], const double (&a)[3], const double (&b)[3]) {
    for (int axis = 0; axis < 3; ++axis) {
      const int next = (axis + 1) % 3, last = (axis + 2) % 3;
      normal[axis] = a[next] * b[last] - a[last] * b[next];
      offset += normal[axis] * corner[axis];
      reach += std::abs(normal[axis]);
    }
    reach *= 0.5 + kSlack;
  }
  bool near(int64_t x, int64_t y, int64_t z) const {
    const double at = normal[0] * (static_cast<double>(x) + 0.5) + normal[1] * (static_cast<double>(y) + 0.5) +
                      normal[2] * (static_cast<double>(z) + 0.5);
    return std::abs(at - offset) <= reach;
  }
  double normal[3], offset = 0, reach = 0;
};

}  // namespace

struct SurfaceTracer::Ray {
  double start[3];        // cells from the grid's lower corner
  double cells_per_m[3];  // never 0
  double m_per_cell[3];
  bool forward[3];

  double position(int axis, double range_m) const { return start[axis] + range_m * cells_per_m[axis]; }
  double face_m(int axis, int64_t face) const { return (static_cast<double>(face) - start[axis]) * m_per_cell[axis]; }
  static int nearest(const double* at_m) {
    const int axis = at_m[1] < at_m[0] ? 1 : 0;
    return at_m[2] < at_m[axis] ? 2 : axis;
  }
};

struct SurfaceTracer::Hit {
  float range_m = kInfinity;
  int32_t face = -1;
};

SurfaceTracer::SurfaceTracer(const double* vertices, int64_t num_vertices, const int32_t* faces, int64_t num_faces,
                             double cell_size_m)
    : cell_size_m_(cell_size_m) {
  if (!(cell_size_m > 0) || !std::isfinite(cell_size_m)) {
    throw std::invalid_argument("cell_size_m must be positive and finite");
  }
  for (int64_t i = 0; i < 3 * num_faces; ++i) {
    if (faces[i] < 0 || faces[i] >= num_vertices) {
      throw std::invalid_argument("a face refers to a vertex that does not exist");
    }
  }
  for (int64_t i = 0; i < 3 * num_vertices; ++i) {
    if (!std::isfinite(vertices[i])) throw std::invalid_argument("vertices must be finite");
  }
  if (num_faces == 0) return;
  make_grid(vertices, faces, num_faces);
  list_triangles(vertices, faces, num_faces);
  measure_gaps();
}

int64_t SurfaceTracer::num_bytes() const {
  return static_cast<int64_t>(blocks_.size() * sizeof(Block) + occupied_.size() * sizeof(Occupancy) +
                              first_.size() * sizeof(int64_t) + triangles_.size() * sizeof(Triangle));
}

void SurfaceTracer::make_grid(const double* vertices, const int32_t* faces, int64_t num_faces) {
  double upper[3];
  for (int axis = 0; axis < 3; ++axis) {
    lower_[axis] = upper[axis] = vertices[3 * int64_t{faces[0]} + axis];
    for (int64_t i = 0; i < 3 * num_faces; ++i) {
      lower_[axis] = std::min(lower_[axis], vertices[3 * int64_t{faces[i]} + axis]);
      upper[axis] = std::max(upper[axis], vertices[3 * int64_t{faces[i]} + axis]);
    }
  }
  while (true) {
    double count = 1;
    for (int axis = 0; axis < 3; ++axis) {
      const double blocks = std::floor((upper[axis] - lower_[axis]) / (cell_size_m_ * kEdge)) + 2;
      count *= blocks;
      size_[axis] = blocks < static_cast<double>(kMaxBlocks) ? static_cast<int64_t>(blocks) : kMaxBlocks;
    }
    if (count <= static_cast<double>(kMaxBlocks)) break;
    cell_size_m_ *= 2;
  }
  for (int axis = 0; axis < 3; ++axis) lower_[axis] -= 0.5 * cell_size_m_;  // room for the slack
  blocks_.assign(static_cast<size_t>(size_[0] * size_[1] * size_[2]), {-1, kMaxGap, kMaxGap});
}

void SurfaceTracer::list_triangles(const double* vertices, const int32_t* faces, int64_t num_faces) {
  // Calls visit(block, bit, corner, a, b) for each cell near a triangle: its first corner and two edges, cells.
  const auto visit_cells = [&](int64_t face, const auto& visit) {
    double corners[3][3], a[3], b[3];
    Box box;
    for (int axis = 0; axis < 3; ++axis) {
      for (int i = 0; i < 3; ++i) {
        corners[i][axis] = (vertices[3 * int64_t{faces[3 * face + i]} + axis] - lower_[axis]) / cell_size_m_;
      }
      a[axis] = corners[1][axis] - corners[0][axis];
      b[axis] = corners[2][axis] - corners[0][axis];
      const auto [low, high] = std::minmax({corners[0][axis], corners[1][axis], corners[2][axis]});
      box.low[axis] = static_cast<int64_t>(std::floor(low - kSlack));
      box.high[axis] = static_cast<int64_t>(std::floor(high + kSlack));
    }
    const PlaneOfTriangle plane(corners[0], a, b);
    for (int64_t x = box.low[0]; x <= box.high[0]; ++x) {
      for (int64_t y = box.low[1]; y <= box.high[1]; ++y) {
        for (int64_t z = box.low[2]; z <= box.high[2]; ++z) {
          if (!plane.near(x, y, z)) continue;
          const int64_t block[3] = {x / kEdge, y / kEdge, z / kEdge};
          const int64_t bit = (x % kEdge * kEdge + y % kEdge) * kEdge + z % kEdge;
          visit(block, static_cast<unsigned>(bit), corners[0], a, b);
        }
      }
    }
  };
  const auto at = [&](const int64_t* block) -> int32_t& {
    return blocks_[static_cast<size_t>((block[0] * size_[1] + block[1]) * size_[2] + block[2])].row;
  };

  int64_t entries = 0;
  for (int64_t face = 0; face < num_faces; ++face) {
    if (face % 4096 == 0) check_interrupt();
    visit_cells(face, [&](const int64_t* block, unsigned bit, const auto&...) {
      int32_t& row = at(block);
      if (row < 0) {
        row = static_cast<int32_t>(occupied_.size());
        occupied_.push_back({0, 0});
      }
      occupied_[static_cast<size_t>(row)].mask |= std::uint64_t{1} << bit;
      if (++entries > kMaxEntries) throw std::invalid_argument("the triangles are too large for such small cells");
    });
  }
  int32_t cells = 0;
  for (Occupancy& block : occupied_) {
    block.first = cells;
    cells += count_bits(block.mask);
  }
  first_.assign(static_cast<size_t>(cells) + 1, 0);
  const auto cell_of = [&](const int64_t* block, unsigned bit) {
    return static_cast<size_t>(occupied_[static_cast<size_t>(at(block))].row(bit));
  };
  for (int64_t face = 0; face < num_faces; ++face) {
    if (face % 4096 == 0) check_interrupt();
    visit_cells(face, [&](const int64_t* block, unsigned bit, const auto&...) { ++first_[cell_of(block, bit) + 1]; });
  }
  for (size_t i = 1; i < first_.size(); ++i) first_[i] += first_[i - 1];
  triangles_.resize(static_cast<size_t>(entries));
  for (int64_t face = 0; face < num_faces; ++face) {
    if (face % 4096 == 0) check_interrupt();
    visit_cells(face, [&](const int64_t* block, unsigned bit, const auto& corner, const auto& a, const auto& b) {
      Triangle& triangle = triangles_[static_cast<size_t>(first_[cell_of(block, bit)]++)];
      for (int axis = 0; axis < 3; ++axis) {
        const double from_block = corner[axis] - static_cast<double>(block[axis] * kEdge);
        triangle.corner[axis] = static_cast<float>(from_block * cell_size_m_);
        triangle.edges[0][axis] = static_cast<float>(a[axis] * cell_size_m_);
        triangle.edges[1][axis] = static_cast<float>(b[axis] * cell_size_m_);
      }
      triangle.face = static_cast<int32_t>(face);
    });
  }
  std::copy_backward(first_.begin(), first_.end() - 1, first_.end());  // they were moved on by one cell
  first_[0] = 0;
}

// Of each empty block the number of steps to the nearest that is not, diagonal ones too: forth and back through the
// array, from neighbours that are known. Once over all steps, once over those that keep the height.
void SurfaceTracer::measure_gaps() {
  for (const bool flat : {false, true}) {
    for (const int step : {1, -1}) sweep(flat, step);
  }
}

void SurfaceTracer::sweep(bool flat, int step) {
  const auto ordered = [&](int axis, int64_t i) { return step > 0 ? i : size_[axis] - 1 - i; };
  for (int64_t i = 0; i < size_[0]; ++i) {
    check_interrupt();
    for (int64_t j = 0; j < size_[1]; ++j) {
      for (int64_t k = 0; k < size_[2]; ++k) {
        const int64_t x = ordered(0, i), y = ordered(1, j), z = ordered(2, k);
        Block& own = blocks_[static_cast<size_t>((x * size_[1] + y) * size_[2] + z)];
        if (own.row >= 0) continue;
        std::uint16_t& gap = flat ? own.flat_gap : own.gap;
        for (int64_t n = 0; n < 13; ++n) {  // the half of the 26 neighbours that was swept before
          const int64_t u = x + step * (n / 9 - 1), v = y + step * (n / 3 % 3 - 1), w = z + step * (n % 3 - 1);
          if ((flat && w != z) || u < 0 || u >= size_[0] || v < 0 || v >= size_[1] || w < 0 || w >= size_[2]) continue;
          const Block& other = blocks_[static_cast<size_t>((u * size_[1] + v) * size_[2] + w)];
          const int past = other.row >= 0 ? 0 : flat ? other.flat_gap : other.gap;
          gap = static_cast<std::uint16_t>(std::min<int>(gap, past + 1));
        }
      }
    }
  }
}

bool SurfaceTracer::hit_in_block(const Ray& ray, const int64_t* block, const Occupancy& cells, double begin_m,
                                 double end_m, bool front_only, Hit& hit) const {
  const double slack_m = kSlack * cell_size_m_;
  int64_t cell[3];  // in the block
  double next_m[3];
  const auto look_ahead = [&](int axis) {
    next_m[axis] = ray.face_m(axis, block[axis] * kEdge + cell[axis] + (ray.forward[axis] ? 1 : 0));
  };
  float direction[3];
  for (int axis = 0; axis < 3; ++axis) {
    const double inside = ray.position(axis, begin_m) - static_cast<double>(block[axis] * kEdge);
    cell[axis] = std::clamp<int64_t>(static_cast<int64_t>(std::floor(inside)), 0, kEdge - 1);
    direction[axis] = static_cast<float>(ray.cells_per_m[axis] * cell_size_m_);
    look_ahead(axis);
  }
  while (true) {
    const int axis = Ray::nearest(next_m);
    const double leave_m = std::min(next_m[axis], end_m);
    const int32_t row = cells.row(static_cast<std::uint64_t>((cell[0] * kEdge + cell[1]) * kEdge + cell[2]));
    if (row >= 0) {
      float start[3];  // of the ray in this cell, m from the block's lower corner: small, so float32 is exact enough
      for (int i = 0; i < 3; ++i) {
        const double inside = ray.position(i, begin_m) - static_cast<double>(block[i] * kEdge);
        start[i] = static_cast<float>(inside * cell_size_m_);
      }
      const auto low = static_cast<float>(std::max(-slack_m, -begin_m));
      auto nearest = static_cast<float>(leave_m - begin_m + slack_m);
      for (int64_t i = first_[static_cast<size_t>(row)]; i < first_[static_cast<size_t>(row) + 1]; ++i) {
        // Moeller and Trumbore 1997
        const Triangle& triangle = triangles_[static_cast<size_t>(i)];
        const float *a = triangle.edges[0], *b = triangle.edges[1], *c = triangle.corner, *d = direction;
        const float p[3] = {d[1] * b[2] - d[2] * b[1], d[2] * b[0] - d[0] * b[2], d[0] * b[1] - d[1] * b[0]};
        const float scale = a[0] * p[0] + a[1] * p[1] + a[2] * p[2];  // positive if the ray meets the front
        if (front_only ? !(scale > 0) : scale == 0) continue;
        const float inverse = 1 / scale;
        const float s[3] = {start[0] - c[0], start[1] - c[1], start[2] - c[2]};
        const float u = (s[0] * p[0] + s[1] * p[1] + s[2] * p[2]) * inverse;
        const float q[3] = {s[1] * a[2] - s[2] * a[1], s[2] * a[0] - s[0] * a[2], s[0] * a[1] - s[1] * a[0]};
        const float v = (d[0] * q[0] + d[1] * q[1] + d[2] * q[2]) * inverse;
        const float at = (b[0] * q[0] + b[1] * q[1] + b[2] * q[2]) * inverse;
        const bool inside = u >= -kEdgeSlack && v >= -kEdgeSlack && u + v <= 1 + kEdgeSlack;
        if (!inside || !(at >= low) || !(at < nearest)) continue;
        nearest = at;
        hit = {static_cast<float>(begin_m + static_cast<double>(at)), triangle.face};
      }
      if (hit.face >= 0) return true;
    }
    if (next_m[axis] >= end_m) return false;
    begin_m = std::max(begin_m, next_m[axis]);
    cell[axis] += ray.forward[axis] ? 1 : -1;
    if (cell[axis] < 0 || cell[axis] >= kEdge) return false;
    look_ahead(axis);
  }
}

SurfaceTracer::Hit SurfaceTracer::first_hit(const Ray& ray, double max_range_m, bool front_only) const {
  double begin_m = 0, end_m = max_range_m;
  for (int axis = 0; axis < 3; ++axis) {  // of the ray in the grid
    const double low_m = ray.face_m(axis, 0), high_m = ray.face_m(axis, size_[axis] * kEdge);
    begin_m = std::max(begin_m, std::min(low_m, high_m));
    end_m = std::min(end_m, std::max(low_m, high_m));
  }
  Hit hit;
  if (!(begin_m <= end_m)) return hit;
  int64_t block[3];
  for (int axis = 0; axis < 3; ++axis) {
    const auto cell = static_cast<int64_t>(std::floor(ray.position(axis, begin_m)));
    block[axis] = std::clamp<int64_t>(cell / kEdge, 0, size_[axis] - 1);
  }
  while (true) {
    const Block& entry = blocks_[static_cast<size_t>((block[0] * size_[1] + block[1]) * size_[2] + block[2])];
    // The ray leaves the cube of the blocks that are nearer than the gap, or the flat box, whichever it leaves later.
    int64_t empty[3];
    double leave_m[3];
    const auto leave = [&](int64_t aside, int64_t up) {
      empty[0] = empty[1] = aside;
      empty[2] = up;
      for (int axis = 0; axis < 3; ++axis) {
        leave_m[axis] = ray.face_m(axis, (block[axis] + (ray.forward[axis] ? empty[axis] : 1 - empty[axis])) * kEdge);
      }
      return Ray::nearest(leave_m);
    };
    int axis;
    if (entry.row >= 0) {
      axis = leave(1, 1);
      const double last_m = std::min(leave_m[axis], end_m);
      const Occupancy& cells = occupied_[static_cast<size_t>(entry.row)];
      if (hit_in_block(ray, block, cells, begin_m, last_m, front_only, hit)) {
        return static_cast<double>(hit.range_m) <= max_range_m ? hit : Hit{};
      }
    } else {
      axis = leave(entry.flat_gap, 1);
      if (entry.gap > 1) {
        const double flat_m = leave_m[axis];
        axis = leave(entry.gap, entry.gap);
        if (leave_m[axis] < flat_m) axis = leave(entry.flat_gap, 1);
      }
    }
    begin_m = std::max(begin_m, leave_m[axis]);
    if (begin_m >= end_m) return hit;
    for (int other = 0; other < 3; ++other) {
      if (other == axis) continue;
      const auto at = static_cast<int64_t>(ray.position(other, begin_m) * (1.0 / kEdge));
      const int64_t low = std::max<int64_t>(block[other] - empty[other] + 1, 0);
      const int64_t high = std::min(block[other] + empty[other], size_[other]) - 1;
      block[other] = std::min(std::max(at, low), high);
    }
    block[axis] += ray.forward[axis] ? empty[axis] : -empty[axis];
    if (block[axis] < 0 || block[axis] >= size_[axis]) return hit;
  }
}

void SurfaceTracer::first_hits(const double* origin, const float* directions, int64_t count, double max_range_m,
                               bool front_only, float* ranges_m, int32_t* faces, int num_threads) const {
  bool finite = max_range_m >= 0;
  for (int axis = 0; axis < 3; ++axis) finite = finite && std::isfinite(origin[axis]);
  for (int64_t i = 0; i < 3 * count; ++i) finite = finite && std::isfinite(directions[i]);
  if (!finite) throw std::invalid_argument("origin and directions must be finite, and max_range_m at least 0");

  constexpr int64_t kRays = 1 << 12;  // a task: few enough for a long walk to be interrupted
  constexpr double kLeast = 1e-30;    // cells a metre, of an axis that the ray does not move along
  parallel_tasks((count + kRays - 1) / kRays, num_threads, [&](int64_t task) {
    for (int64_t i = task * kRays; i < std::min(count, (task + 1) * kRays); ++i) {
      Hit hit;
      if (!blocks_.empty()) {
        Ray ray;
        for (int axis = 0; axis < 3; ++axis) {
          const double step = static_cast<double>(directions[3 * i + axis]) / cell_size_m_;
          ray.start[axis] = (origin[axis] - lower_[axis]) / cell_size_m_;
          ray.cells_per_m[axis] = std::abs(step) < kLeast ? kLeast : step;
          ray.m_per_cell[axis] = 1 / ray.cells_per_m[axis];
          ray.forward[axis] = ray.cells_per_m[axis] > 0;
        }
        hit = first_hit(ray, max_range_m, front_only);
      }
      ranges_m[i] = hit.range_m;
      faces[i] = hit.face;
    }
  });
}

}  // namespace radarsdf
