#include "poses/local_planes.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "returns/principal_axes.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int kAxisBits = 21;  // bits of a key
constexpr std::int64_t kHalf = std::int64_t{1} << (kAxisBits - 1);
constexpr std::uint64_t kAxisMask = (std::uint64_t{1} << kAxisBits) - 1;
constexpr double kQuanta = 1 << 12;                                  // per cell edge
constexpr double kWeights[] = {1, 0.7, 0.7 * 0.7, 0.7 * 0.7 * 0.7};  // as for surfels: itself, face, edge, corner
constexpr double kMinReturns = 8;     // weighted; the variance of a plane expresses its uncertainty
constexpr double kMaxFlatness = 0.5;  // as for surfels
constexpr int kFirstProduct = 4;
constexpr std::int32_t kUnknown = -1, kNoPlane = -2;  // in place of the row of a plane

std::int64_t axis_of(std::uint64_t key, int axis) {
  return static_cast<std::int64_t>((key >> (kAxisBits * axis)) & kAxisMask);
}

// A cell of the 27 around a cell: in a table, since searches reach many empty cells, and look for returns around each.
struct Neighbour {
  double step[3], weight;
  std::uint64_t key;  // to add to that of the cell
};

constexpr std::array<Neighbour, 27> kNeighbours = [] {
  std::array<Neighbour, 27> found{};
  for (std::size_t i = 0; i < 27; ++i) {
    const int at = static_cast<int>(i), steps[] = {at % 3 - 1, at / 3 % 3 - 1, at / 9 - 1};
    std::size_t apart = 0;
    for (int axis = 0; axis < 3; ++axis) {
      found[i].step[axis] = steps[axis];
      found[i].key += static_cast<std::uint64_t>(std::int64_t{steps[axis]}) << (kAxisBits * axis);
      apart += steps[axis] != 0;
    }
    found[i].weight = kWeights[apart];
  }
  return found;
}();

Vec3 rotate(const double* pose, const Vec3& vector) {
  return {dot(vec3(pose), vector), dot(vec3(pose + 4), vector), dot(vec3(pose + 8), vector)};
}

Vec3 rotate_back(const double* pose, const Vec3& vector) {
  return vector[0] * vec3(pose) + vector[1] * vec3(pose + 4) + vector[2] * vec3(pose + 8);
}

Vec3 translation(const double* pose) { return {pose[3], pose[7], pose[11]}; }

}  // namespace

LocalPlanes::LocalPlanes(double cell_size_m) : cell_size_m_(cell_size_m), cells_per_m_(1 / cell_size_m) {
  if (!(cell_size_m > 0)) throw std::invalid_argument("cell_size_m must be positive");
}

std::optional<std::uint64_t> LocalPlanes::key(const Vec3& point) const {
  std::uint64_t cell = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double place = cells_per_m_ * point[axis] + static_cast<double>(kHalf);
    if (!(place >= 1 && place < static_cast<double>(kAxisMask))) return std::nullopt;  // neighbours need valid keys
    cell |= static_cast<std::uint64_t>(place) << (kAxisBits * axis);
  }
  return cell;
}

void LocalPlanes::add(const double* points, std::int64_t count, int sign) {
  FlatMap order;
  std::vector<std::pair<std::uint64_t, Moments>> change;
  for (std::int64_t i = 0; i < count; ++i) {
    const Vec3 point = vec3(points, i);
    const auto cell = key(point);
    if (!cell) throw std::invalid_argument("a point is too far from the origin for cells of this size");
    const auto row = static_cast<std::size_t>(order.find_or_insert(*cell, static_cast<std::int32_t>(change.size())));
    if (row == change.size()) change.push_back({*cell, {}});
    std::int64_t x[3];
    for (int axis = 0; axis < 3; ++axis) {
      const double corner = static_cast<double>(axis_of(*cell, axis) - kHalf);
      x[axis] = std::llround((cells_per_m_ * point[axis] - corner) * kQuanta);
    }
    const Moments of_point{1,           x[0],        x[1],        x[2],        x[0] * x[0],
                           x[0] * x[1], x[0] * x[2], x[1] * x[1], x[1] * x[2], x[2] * x[2]};
    for (std::size_t k = 0; k < kMoments; ++k) change[row].second[k] += sign * of_point[k];
  }
  for (const auto& [cell, sums] : change) {
    const std::int32_t row = cells_.find(cell);
    if ((row < 0 ? 0 : sums_[static_cast<std::size_t>(row)][0]) + sums[0] < 0) {
      throw std::invalid_argument("points that were never added cannot be taken out");
    }
  }
  for (const auto& [cell, sums] : change) {
    Moments& all = value_at(cells_, sums_, free_, cell);
    for (std::size_t k = 0; k < kMoments; ++k) all[k] += sums[k];
    if (all[0] == 0) {
      free_.push_back(cells_.find(cell));
      cells_.erase(cell);
    }
  }
  // Not cleared: after a search, those of a scan would touch megabytes.
  for (Known& known : known_) known = {FlatMap(known.planes.size()), {}};
}

std::optional<LocalPlanes::Plane> LocalPlanes::plane_of(std::uint64_t key) const {
  const Moments* near[27];
  double count = 0, sum[3] = {}, products[6] = {};
  for (std::size_t i = 0; i < 27; ++i) {
    const std::int32_t row = cells_.find(key + kNeighbours[i].key);
    near[i] = row < 0 ? nullptr : &sums_[static_cast<std::size_t>(row)];
    if (row >= 0) count += kNeighbours[i].weight * static_cast<double>(near[i]->front());
  }
  if (count < kMinReturns) return std::nullopt;
  // Moments about the middle of the cell, where products of coordinates are small.
  for (std::size_t i = 0; i < 27; ++i) {
    if (near[i] == nullptr) continue;
    const Neighbour& next = kNeighbours[i];
    const Moments& m = *near[i];
    const double w = next.weight, n = static_cast<double>(m[0]);
    double inner[3], shift[3];
    for (std::size_t a = 0; a < 3; ++a) {
      inner[a] = static_cast<double>(m[1 + a]) / kQuanta;
      shift[a] = next.step[a] - 0.5;
      sum[a] += w * (inner[a] + n * shift[a]);
    }
    std::size_t k = 0;
    for (std::size_t a = 0; a < 3; ++a) {
      for (std::size_t b = a; b < 3; ++b, ++k) {
        const double inside = static_cast<double>(m[kFirstProduct + k]) / (kQuanta * kQuanta);
        products[k] += w * (inside + shift[a] * inner[b] + shift[b] * inner[a] + n * shift[a] * shift[b]);
      }
    }
  }
  double covariance[9], values[3], vectors[9];
  std::size_t k = 0;
  for (std::size_t a = 0; a < 3; ++a) {
    for (std::size_t b = a; b < 3; ++b, ++k)
      covariance[3 * a + b] = products[k] / count - sum[a] / count * sum[b] / count;
  }
  principal_axes(covariance, 1, values, vectors, 1);
  Plane found;
  for (int a = 0; a < 3; ++a) {
    found.centre[a] = cell_size_m_ * (static_cast<double>(axis_of(key, a) - kHalf) + 0.5 + sum[a] / count);
    // Degrees of freedom: three parameters were fitted to these returns.
    values[a] = std::max(cell_size_m_ * cell_size_m_ * values[a] * count / (count - 3), kLeastM2);
  }
  if (!(values[0] < kMaxFlatness * values[1])) return std::nullopt;
  // Variances of the regression: of its mean and its two slopes.
  found.variance = values[0] / count;
  for (int a = 0; a < 3; ++a) {
    const Vec3 axis{vectors[a], vectors[3 + a], vectors[6 + a]};
    found.axes[a] = a == 0 ? axis : std::sqrt(found.variance / values[a]) * axis;
  }
  return found;
}

std::optional<LocalPlanes::Residual> LocalPlanes::residual(const Beam& beam, const double* pose,
                                                           const ReturnVariances& noise, Known& known) const {
  const Vec3 point = rotate(pose, beam.point) + translation(pose);
  const auto cell = key(point);
  std::int32_t row = cell ? known.rows.find(*cell) : kNoPlane;
  if (row == kUnknown) {
    const std::optional<Plane> plane = plane_of(*cell);
    row = plane ? static_cast<std::int32_t>(known.planes.size()) : kNoPlane;
    known.rows.insert(*cell, row);
    if (plane) known.planes.push_back(*plane);
  }
  if (row == kNoPlane) return std::nullopt;
  const Plane& here = known.planes[static_cast<std::size_t>(row)];
  const Vec3 off = point - here.centre;
  const double first = dot(off, here.axes[1]), second = dot(off, here.axes[2]);
  const double of_plane = here.variance + first * first + second * second;
  const double of_return = beam.variance_along(rotate_back(pose, here.axes[0]), noise);
  return Residual{dot(off, here.axes[0]), of_return + of_plane + kLeastM2, row};
}

Agreement LocalPlanes::agreement(const double* points, std::int64_t count, const double* pose,
                                 const ReturnVariances& noise) const {
  std::vector<std::pair<Residual, Vec3>> rows;  // and arms
  std::vector<double> squares;
  rows.reserve(count);
  squares.reserve(count);
  for (std::int64_t i = 0; i < count; ++i) {
    const Beam beam(vec3(points, i), {0, 0, 1});
    const auto found = residual(beam, pose, noise, known_.front());
    if (!found) continue;
    rows.push_back({*found, rotate(pose, beam.point)});
    squares.push_back(found->value * found->value / found->variance);
  }
  Agreement found;
  if (rows.empty()) return found;
  const double scale = scale_of(squares);
  for (const auto& [residual, arm] : rows) {
    const double variance = scale * residual.variance, share = robust_share(residual.value, variance);
    const double weight = share * share, information = weight / variance;
    found.weight += weight;
    const Plane& of = known_.front().planes[static_cast<std::size_t>(residual.plane)];
    double normal[kPose], tilts[2][kPose];  // Jacobians
    for (int k = 0; k < 3; ++k) {
      store(of.axes[k], k == 0 ? normal : tilts[k - 1]);
      store(cross(arm, of.axes[k]), 3 + (k == 0 ? normal : tilts[k - 1]));
    }
    for (std::size_t a = 0; a < kPose; ++a) {
      const double scaled = information * normal[a];
      found.gradient[a] += scaled * residual.value;
      for (std::size_t b = 0; b <= a; ++b) {
        found.hessian[kPose * a + b] += scaled * normal[b];
        found.doubt[kPose * a + b] += information * (tilts[0][a] * tilts[0][b] + tilts[1][a] * tilts[1][b]);
      }
    }
  }
  for (std::size_t a = 0; a < kPose; ++a) {
    for (std::size_t b = 0; b < a; ++b) {
      for (auto* of : {&found.hessian, &found.doubt}) (*of)[kPose * b + a] = (*of)[kPose * a + b];
    }
  }
  return found;
}

void LocalPlanes::scores(const double* points, std::int64_t count, const double* poses, std::int64_t num_poses,
                         const ReturnVariances& noise, double* scores, int num_threads) const {
  const auto parts = std::clamp<std::int64_t>(count, 1, resolve_num_threads(num_threads));
  known_.resize(std::max(known_.size(), static_cast<std::size_t>(parts)));
  parallel_tasks(parts, num_threads, [&](std::int64_t part) {
    Known& known = known_[static_cast<std::size_t>(part)];
    // Return by return, whose cells at all poses stay in the cache.
    for (std::int64_t i = count * part / parts; i < count * (part + 1) / parts; ++i) {
      const Beam beam(vec3(points, i), {0, 0, 1});
      for (std::int64_t k = 0; k < num_poses; ++k) {
        const auto found = residual(beam, poses + 16 * k, noise, known);
        scores[count * k + i] = found ? robust_share(found->value, found->variance) : 0.0;
      }
    }
  });
}

}  // namespace radarsdf
