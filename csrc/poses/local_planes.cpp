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
constexpr double kQuanta = 1 << 12;       // per cell edge
constexpr double kNeighbourWeight = 0.7;  // as for surfels: across a common face; its square across an edge
constexpr double kMinReturns = 8;         // weighted; the variance of a plane expresses its uncertainty
constexpr double kMaxFlatness = 0.5;      // as for surfels
constexpr double kSigmas2 = 4;            // squared scale of the Geman-McClure weight: 1/4 at two standard deviations
constexpr double kMedianOfSquare = 0.4549;
constexpr double kLeastM2 = 1e-10;  // lower bound of variances, which are divisors
constexpr int kFirstProduct = 4;

std::int64_t axis_of(std::uint64_t key, int axis) {
  return static_cast<std::int64_t>((key >> (kAxisBits * axis)) & kAxisMask);
}

std::uint64_t key_of(const std::int64_t* cell) {
  std::uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) key |= static_cast<std::uint64_t>(cell[axis]) << (kAxisBits * axis);
  return key;
}

Vec3 rotate(const double* pose, const Vec3& vector) {
  return {dot(vec3(pose), vector), dot(vec3(pose + 4), vector), dot(vec3(pose + 8), vector)};
}

Vec3 translation(const double* pose) { return {pose[3], pose[7], pose[11]}; }

// A return in the sensor frame.
struct Beam {
  Vec3 point, direction;
  double range_m;
};

std::vector<Beam> beams_of(const double* points, std::int64_t count) {
  std::vector<Beam> beams;
  for (std::int64_t i = 0; i < count; ++i) {
    const Vec3 point = vec3(points, i);
    beams.push_back({point, point / std::max(norm(point), 1e-9), norm(point)});
  }
  return beams;
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

LocalPlanes::Moments LocalPlanes::moments(const Vec3& point, std::uint64_t key) const {
  std::int64_t x[3];
  for (int axis = 0; axis < 3; ++axis) {
    const double corner = static_cast<double>(axis_of(key, axis) - kHalf);
    x[axis] = std::llround((point[axis] / cell_size_m_ - corner) * kQuanta);
  }
  return {1, x[0], x[1], x[2], x[0] * x[0], x[0] * x[1], x[0] * x[2], x[1] * x[1], x[1] * x[2], x[2] * x[2]};
}

void LocalPlanes::add(const double* points, std::int64_t count, int sign) {
  std::unordered_map<std::uint64_t, Moments> change;
  for (std::int64_t i = 0; i < count; ++i) {
    const Vec3 point = vec3(points, i);
    const auto cell = key(point);
    if (!cell) throw std::invalid_argument("a point is too far from the origin for cells of this size");
    Moments& sums = change.try_emplace(*cell).first->second;
    const Moments of_point = moments(point, *cell);
    for (std::size_t k = 0; k < kMoments; ++k) sums[k] += sign * of_point[k];
  }
  for (const auto& [cell, sums] : change) {
    const auto there = cells_.find(cell);
    if ((there == cells_.end() ? 0 : there->second[0]) + sums[0] < 0) {
      throw std::invalid_argument("points that were never added cannot be taken out");
    }
  }
  for (const auto& [cell, sums] : change) {
    Moments& all = cells_.try_emplace(cell).first->second;
    for (std::size_t k = 0; k < kMoments; ++k) all[k] += sums[k];
    if (all[0] == 0) cells_.erase(cell);
  }
  planes_.clear();
}

LocalPlanes::Plane LocalPlanes::plane_of(std::uint64_t key) const {
  // Moments about the middle of the cell, where products of coordinates are small.
  double count = 0, sum[3] = {}, products[6] = {};
  std::int64_t cell[3];
  for (int axis = 0; axis < 3; ++axis) cell[axis] = axis_of(key, axis);
  for (int i = 0; i < 27; ++i) {
    const std::int64_t step[3] = {i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1};
    const std::int64_t other[3] = {cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]};
    const auto there = cells_.find(key_of(other));
    if (there == cells_.end()) continue;
    const Moments& m = there->second;
    const double w = std::pow(kNeighbourWeight, std::abs(step[0]) + std::abs(step[1]) + std::abs(step[2]));
    const double n = static_cast<double>(m[0]);
    double inner[3], shift[3];
    for (std::size_t a = 0; a < 3; ++a) {
      inner[a] = static_cast<double>(m[1 + a]) / kQuanta;
      shift[a] = static_cast<double>(step[a]) - 0.5;
      sum[a] += w * (inner[a] + n * shift[a]);
    }
    std::size_t k = 0;
    for (std::size_t a = 0; a < 3; ++a) {
      for (std::size_t b = a; b < 3; ++b, ++k) {
        const double inside = static_cast<double>(m[kFirstProduct + k]) / (kQuanta * kQuanta);
        products[k] += w * (inside + shift[a] * inner[b] + shift[b] * inner[a] + n * shift[a] * shift[b]);
      }
    }
    count += w * n;
  }
  Plane found;
  found.count = count;
  if (count < kMinReturns) return found;
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
  found.flat = found.variances[0] < kMaxFlatness * found.variances[1];
  return found;
}

const LocalPlanes::Plane& LocalPlanes::plane(std::uint64_t key) const {
  const auto known = planes_.find(key);
  return known != planes_.end() ? known->second : planes_.emplace(key, plane_of(key)).first->second;
}

std::optional<LocalPlanes::Residual> LocalPlanes::residual(const Vec3& point, const float* direction, double range_m,
                                                           const Vec3& up, const ReturnVariances& noise) const {
  const auto cell = key(point);
  if (!cell) return std::nullopt;
  const Plane& here = plane(*cell);
  if (!here.flat) return std::nullopt;
  const Vec3 off = point - here.centre;
  // Variance factor of the regression at this point: of its mean and its two slopes.
  double spread = 1;
  for (int a = 1; a < 3; ++a) {
    const double along = dot(off, here.axes[a]);
    spread += along * along / here.variances[a];
  }
  const double of_plane = here.variances[0] / here.count * spread;
  const double of_return = variance_along(here.axes[0], vec3(direction), range_m, up, noise);
  return Residual{dot(off, here.axes[0]), of_return + of_plane + kLeastM2, &here};
}

Agreement LocalPlanes::agreement(const double* points, std::int64_t count, const double* pose,
                                 const ReturnVariances& noise) const {
  const Vec3 up{pose[2], pose[6], pose[10]};
  struct Row {
    Residual residual;
    Vec3 arm;
  };
  std::vector<Row> rows;
  std::vector<double> squares;
  for (const Beam& beam : beams_of(points, count)) {
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
  for (const Row& row : rows) {
    const double value = row.residual.value, variance = scale * row.residual.variance;
    const double share = 1 / (1 + value * value / (kSigmas2 * variance));
    const double weight = share * share, information = weight / variance;
    found.weight += weight;
    const Plane& of = *row.residual.plane;
    for (int k = 0; k < 3; ++k) {  // the normal, then its two tilts
      double jacobian[kPose];
      store(of.axes[k], jacobian);
      store(cross(row.arm, of.axes[k]), jacobian + 3);
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
  const std::vector<Beam> beams = beams_of(points, count);
  for (std::int64_t k = 0; k < num_poses; ++k) {
    const double* pose = poses + 16 * k;
    const Vec3 up{pose[2], pose[6], pose[10]};
    for (const Beam& beam : beams) {
      const Vec3 exact = rotate(pose, beam.direction);
      float direction[3];
      store(exact, direction);
      const auto found = residual(beam.range_m * exact + translation(pose), direction, beam.range_m, up, noise);
      *scores++ = found ? 1 / (1 + found->value * found->value / (kSigmas2 * found->variance)) : 0.0;
    }
  }
}

}  // namespace radarsdf
