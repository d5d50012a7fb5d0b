#include "poses/local_planes.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "returns/principal_axes.hpp"

namespace radarsdf {
namespace {

constexpr int kAxisBits = 21;  // bits of a key
constexpr std::int64_t kHalf = std::int64_t{1} << (kAxisBits - 1);
constexpr std::uint64_t kAxisMask = (std::uint64_t{1} << kAxisBits) - 1;
constexpr double kQuanta = 1 << 12;                                  // per cell edge
constexpr double kWeights[] = {1, 0.7, 0.7 * 0.7, 0.7 * 0.7 * 0.7};  // as for surfels: itself, face, edge, corner
constexpr double kMinReturns = 8;     // weighted; the variance of a plane expresses its uncertainty
constexpr double kMaxFlatness = 0.5;  // as for surfels
constexpr double kSigmas2 = 4;        // squared scale of the Geman-McClure weight: 1/4 at two standard deviations
constexpr double kMedianOfSquare = 0.4549;
constexpr double kLeastM2 = 1e-10;  // lower bound of variances, which are divisors
constexpr int kFirstProduct = 4;
constexpr std::int32_t kUnknown = -1, kNoPlane = -2;  // in place of the row of a plane

std::int64_t axis_of(std::uint64_t key, int axis) {
  return static_cast<std::int64_t>((key >> (kAxisBits * axis)) & kAxisMask);
}

std::uint64_t key_of(const std::int64_t* cell) {
  std::uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) key |= static_cast<std::uint64_t>(cell[axis]) << (kAxisBits * axis);
  return key;
}

// A cell of the 27 around a cell.
struct Neighbour {
  explicit Neighbour(int i) : step{i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1} {}
  double weight() const { return kWeights[std::abs(step[0]) + std::abs(step[1]) + std::abs(step[2])]; }
  int step[3];
};

Vec3 rotate(const double* pose, const Vec3& vector) {
  return {dot(vec3(pose), vector), dot(vec3(pose + 4), vector), dot(vec3(pose + 8), vector)};
}

Vec3 translation(const double* pose) { return {pose[3], pose[7], pose[11]}; }

// A return in the sensor frame.
struct Beam {
  Vec3 point, direction;
  double range_m;
};

Beam beam_of(const double* points, std::int64_t i) {
  const Vec3 point = vec3(points, i);
  return {point, point / std::max(norm(point), 1e-9), norm(point)};
}

}  // namespace

LocalPlanes::LocalPlanes(double cell_size_m) : cell_size_m_(cell_size_m) {
  if (!(cell_size_m > 0)) throw std::invalid_argument("cell_size_m must be positive");
}

std::optional<std::uint64_t> LocalPlanes::key(const Vec3& point) const {
  std::int64_t cell[3];
  for (int axis = 0; axis < 3; ++axis) {
    const double place = std::floor(point[axis] / cell_size_m_) + static_cast<double>(kHalf);
    if (!(place >= 1 && place < static_cast<double>(kAxisMask))) return std::nullopt;  // neighbours need valid keys
    cell[axis] = static_cast<std::int64_t>(place);
  }
  return key_of(cell);
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
      x[axis] = std::llround((point[axis] / cell_size_m_ - corner) * kQuanta);
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
  known_ = FlatMap(planes_.size());  // not cleared: after a search, that of a scan would touch megabytes
  planes_.clear();
}

std::optional<LocalPlanes::Plane> LocalPlanes::plane_of(std::uint64_t key) const {
  const Moments* near[27] = {};
  double count = 0, sum[3] = {}, products[6] = {};
  std::int64_t cell[3];
  for (int axis = 0; axis < 3; ++axis) cell[axis] = axis_of(key, axis);
  for (int i = 0; i < 27; ++i) {
    const Neighbour next(i);
    const std::int64_t other[3] = {cell[0] + next.step[0], cell[1] + next.step[1], cell[2] + next.step[2]};
    const std::int32_t row = cells_.find(key_of(other));
    if (row < 0) continue;
    near[i] = &sums_[static_cast<std::size_t>(row)];
    count += next.weight() * static_cast<double>(near[i]->front());
  }
  if (count < kMinReturns) return std::nullopt;
  // Moments about the middle of the cell, where products of coordinates are small.
  for (int i = 0; i < 27; ++i) {
    if (near[i] == nullptr) continue;
    const Moments& m = *near[i];
    const Neighbour next(i);
    const double w = next.weight(), n = static_cast<double>(m[0]);
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
  Plane found;
  found.count = count;
  double covariance[9], vectors[9];
  std::size_t k = 0;
  for (std::size_t a = 0; a < 3; ++a) {
    for (std::size_t b = a; b < 3; ++b, ++k) {
      covariance[3 * a + b] = covariance[3 * b + a] = products[k] / count - sum[a] / count * sum[b] / count;
    }
  }
  principal_axes(covariance, 1, found.variances, vectors, 1);
  for (int a = 0; a < 3; ++a) {
    const double middle = static_cast<double>(cell[a] - kHalf) + 0.5;
    found.centre[a] = cell_size_m_ * (middle + sum[a] / count);
    // Degrees of freedom: three parameters were fitted to these returns.
    found.variances[a] = std::max(cell_size_m_ * cell_size_m_ * found.variances[a] * count / (count - 3), kLeastM2);
    for (int axis = 0; axis < 3; ++axis) found.axes[a][axis] = vectors[3 * axis + a];
  }
  return found.variances[0] < kMaxFlatness * found.variances[1] ? std::optional(found) : std::nullopt;
}

std::optional<LocalPlanes::Residual> LocalPlanes::residual(const Vec3& point, const float* direction, double range_m,
                                                           const Vec3& up, const ReturnVariances& noise) const {
  const auto cell = key(point);
  std::int32_t row = cell ? known_.find(*cell) : kNoPlane;
  if (row == kUnknown) {
    const std::optional<Plane> plane = plane_of(*cell);
    row = plane ? static_cast<std::int32_t>(planes_.size()) : kNoPlane;
    known_.insert(*cell, row);
    if (plane) planes_.push_back(*plane);
  }
  if (row == kNoPlane) return std::nullopt;
  const Plane& here = planes_[static_cast<std::size_t>(row)];
  const Vec3 off = point - here.centre;
  // Variance factor of the regression at this point: of its mean and its two slopes.
  double spread = 1;
  for (int a = 1; a < 3; ++a) {
    const double along = dot(off, here.axes[a]);
    spread += along * along / here.variances[a];
  }
  const double of_plane = here.variances[0] / here.count * spread;
  const double of_return = variance_along(here.axes[0], vec3(direction), range_m, up, noise);
  return Residual{dot(off, here.axes[0]), of_return + of_plane + kLeastM2, row};
}

Agreement LocalPlanes::agreement(const double* points, std::int64_t count, const double* pose,
                                 const ReturnVariances& noise) const {
  const Vec3 up{pose[2], pose[6], pose[10]};
  std::vector<std::pair<Residual, Vec3>> rows;  // and arms
  std::vector<double> squares;
  for (std::int64_t i = 0; i < count; ++i) {
    const Beam beam = beam_of(points, i);
    const Vec3 arm = rotate(pose, beam.point);
    float direction[3];
    store(rotate(pose, beam.direction), direction);
    const auto found = residual(arm + translation(pose), direction, beam.range_m, up, noise);
    if (!found) continue;
    rows.push_back({*found, arm});
    squares.push_back(found->value * found->value / found->variance);
  }
  Agreement found;
  if (rows.empty()) return found;
  const auto middle = squares.begin() + static_cast<std::ptrdiff_t>(squares.size() / 2);
  std::nth_element(squares.begin(), middle, squares.end());
  const double scale = std::max(1.0, *middle / kMedianOfSquare);  // as in CommonPlanes
  for (const auto& [residual, arm] : rows) {
    const double value = residual.value, variance = scale * residual.variance;
    const double share = 1 / (1 + value * value / (kSigmas2 * variance));
    const double weight = share * share, information = weight / variance;
    found.weight += weight;
    const Plane& of = planes_[static_cast<std::size_t>(residual.plane)];
    for (int k = 0; k < 3; ++k) {  // the normal, then its two tilts
      double jacobian[kPose];
      store(of.axes[k], jacobian);
      store(cross(arm, of.axes[k]), jacobian + 3);
      const double scaled = k == 0 ? information : information * of.variances[0] / (of.count * of.variances[k]);
      auto& sums = k == 0 ? found.hessian : found.doubt;
      for (std::size_t a = 0; a < kPose; ++a) {
        if (k == 0) found.gradient[a] += information * value * jacobian[a];
        for (std::size_t b = 0; b < kPose; ++b) sums[kPose * a + b] += scaled * jacobian[a] * jacobian[b];
      }
    }
  }
  return found;
}

void LocalPlanes::scores(const double* points, std::int64_t count, const double* poses, std::int64_t num_poses,
                         const ReturnVariances& noise, double* scores) const {
  // Return by return, whose cells at all poses stay in the cache.
  for (std::int64_t i = 0; i < count; ++i) {
    const Beam beam = beam_of(points, i);
    for (std::int64_t k = 0; k < num_poses; ++k) {
      const double* pose = poses + 16 * k;
      const Vec3 up{pose[2], pose[6], pose[10]}, exact = rotate(pose, beam.direction);
      float direction[3];
      store(exact, direction);
      const auto found = residual(beam.range_m * exact + translation(pose), direction, beam.range_m, up, noise);
      scores[count * k + i] = found ? 1 / (1 + found->value * found->value / (kSigmas2 * found->variance)) : 0.0;
    }
  }
}

}  // namespace radarsdf
