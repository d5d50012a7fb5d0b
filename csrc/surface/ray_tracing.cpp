#include "surface/ray_tracing.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "lattice/morton.hpp"
#include "surface/ray_packet.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"
#include "util/sorting.hpp"

namespace radarsdf {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr int64_t kSortedRays = int64_t{1} << 22;  // per pass: 16 bytes each
constexpr int64_t kTaskRays = int64_t{1} << 12;    // few, so that a call can be interrupted
constexpr double kFarther = 1.0001;                // margin beyond max_range_m: ranges become exact only at the end

// Rows of directions (count, 3), below 2^32, in Morton order, so that neighbours have similar directions.
class ByDirection {
 public:
  ByDirection(const float* directions, int64_t count, int num_threads) : keys_(count) {
    parallel_for(count, kTaskRays, num_threads,
                 [&](int64_t i) { keys_[i] = key(directions + 3 * i) << 32 | static_cast<uint64_t>(i); });
    radix_sort(keys_, 32, 32 + 3 * kBits);  // std::sort takes longer than the rays
  }
  int64_t row(int64_t i) const { return static_cast<int64_t>(keys_[i] & 0xffffffff); }

 private:
  static constexpr int kBits = 10;  // per axis

  static uint64_t key(const float* direction) {
    constexpr float kHalf = 1 << (kBits - 1);
    std::uint32_t cell[3];
    for (int axis = 0; axis < 3; ++axis) {
      cell[axis] = static_cast<std::uint32_t>(std::clamp(kHalf + kHalf * direction[axis], 0.0F, 2 * kHalf - 1));
    }
    return morton_key(cell[0], cell[1], cell[2]);
  }

  UninitialisedVector<uint64_t> keys_;
};

// Distance from the origin to the plane of a triangle along the ray, m.
double range_to(const TreeTriangle& triangle, const double* origin, const float* direction) {
  const float *a = triangle.edges[0], *b = triangle.edges[1];
  double height = 0, slope = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3, last = (axis + 2) % 3;
    const double normal = double{a[next]} * double{b[last]} - double{a[last]} * double{b[next]};
    height += normal * (triangle.corner[axis] - origin[axis]);
    slope += normal * double{direction[axis]};
  }
  return std::max(height / slope, 0.0);
}

}  // namespace

void SurfaceTracer::first_hits(const double* origin, const float* directions, int64_t count, double max_range_m,
                               bool front_only, float* ranges_m, int32_t* faces, int num_threads) const {
  bool finite = max_range_m >= 0;
  for (int axis = 0; axis < 3; ++axis) finite = finite && std::isfinite(origin[axis]);
  for (int64_t i = 0; i < 3 * count; ++i) finite = finite && std::isfinite(directions[i]);
  if (!finite) throw std::invalid_argument("origin and directions must be finite, and max_range_m at least 0");
  std::fill_n(ranges_m, count, kInfinity);
  std::fill_n(faces, count, -1);
  if (tree_.size() == 0) return;

  const auto limit_m = static_cast<float>(max_range_m * kFarther);
  const auto trace_packet = [&](const std::array<int64_t, RayPacket::kRays>& rows) {
    RayPacket packet;
    for (size_t i = 0; i < rows.size(); ++i) {
      for (int axis = 0; axis < 3; ++axis) packet.directions[axis][i] = directions[3 * rows[i] + axis];
      packet.ranges_m[i] = limit_m;
      packet.triangles[i] = -1;
    }
    trace(tree_, origin, front_only, packet);
    for (size_t i = 0; i < rows.size(); ++i) {
      if (packet.triangles[i] < 0) continue;
      const TreeTriangle& triangle = tree_.triangles[packet.triangles[i]];
      const double range_m = range_to(triangle, origin, directions + 3 * rows[i]);
      if (!(range_m <= max_range_m)) continue;
      ranges_m[rows[i]] = static_cast<float>(range_m);
      faces[rows[i]] = triangle.face;
    }
  };
  for (int64_t begin = 0; begin < count; begin += kSortedRays) {
    const int64_t size = std::min(count - begin, kSortedRays);
    const ByDirection order(directions + 3 * begin, size, num_threads);
    parallel_chunks(size, kTaskRays, num_threads, [&](int64_t, int64_t task_begin, int64_t task_end) {
      for (int64_t first = task_begin; first < task_end; first += RayPacket::kRays) {
        std::array<int64_t, RayPacket::kRays> rows;
        for (int64_t i = 0; i < RayPacket::kRays; ++i) {  // the last packet is padded with its last ray
          rows[i] = begin + order.row(std::min(first + i, size - 1));
        }
        trace_packet(rows);
      }
    });
  }
}

}  // namespace radarsdf
