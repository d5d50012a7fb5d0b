#include "poses/common_planes.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>
#include <utility>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int kPlane = 3;  // unknowns of a plane
constexpr int kCoupling = kPlane * kPose;

// Completes the unit vector n to an orthonormal basis.
std::pair<Vec3, Vec3> tangents(const Vec3& n) {
  const Vec3 across = cross(n, std::abs(n[0]) < 0.9 ? Vec3{1, 0, 0} : Vec3{0, 1, 0});
  const Vec3 e1 = across / norm(across);
  return {e1, cross(n, e1)};
}

// y += block x, or block^T x; block: (rows, 6).
template <int kRows>
void add_product(const double* block, const double* x, double* y) {
  for (int a = 0; a < kRows; ++a) {
    for (int b = 0; b < kPose; ++b) y[a] += block[kPose * a + b] * x[b];
  }
}

template <int kRows>
void add_transposed_product(const double* block, const double* x, double* y) {
  for (int a = 0; a < kRows; ++a) {
    for (int b = 0; b < kPose; ++b) y[b] += block[kPose * a + b] * x[a];
  }
}

// Normal equations over the returns of a plane, or of some scans of it.
struct PlaneSums {
  double a[kPlane][kPlane] = {};  // w t t^T
  double u[kPlane] = {};          // w t r

  void add(const double* t, double w, double value) {
    for (int k = 0; k < kPlane; ++k) {
      for (int l = 0; l <= k; ++l) a[k][l] += w * t[k] * t[l];
      u[k] += w * t[k] * value;
    }
  }

  void add(const PlaneSums& other) {
    for (int k = 0; k < kPlane; ++k) {
      for (int l = 0; l <= k; ++l) a[k][l] += other.a[k][l];
      u[k] += other.u[k];
    }
  }

  // Replaces a by its Cholesky factor. Unobservable parameters, such as a tilt about a line of returns, stay fixed.
  void factor() {
    const double small = 1e-9 * (a[0][0] + a[1][1] + a[2][2]) + 1e-30;
    for (int j = 0; j < kPlane; ++j) {
      double pivot = a[j][j] + small;
      for (int k = 0; k < j; ++k) pivot -= a[j][k] * a[j][k];
      pivot = std::sqrt(std::max(pivot, small));
      a[j][j] = pivot;
      for (int i = j + 1; i < kPlane; ++i) {
        for (int k = 0; k < j; ++k) a[i][j] -= a[i][k] * a[j][k];
        a[i][j] /= pivot;
      }
    }
  }

  // Multiplies `columns` columns by L^-1, in place.
  void divide(double* b, int columns) const {
    for (int c = 0; c < columns; ++c) {
      for (int k = 0; k < kPlane; ++k) {
        for (int l = 0; l < k; ++l) b[columns * k + c] -= a[k][l] * b[columns * l + c];
        b[columns * k + c] /= a[k][k];
      }
    }
  }
};

}  // namespace

struct CommonPlanes::Input {
  const PosedReturns& returns;
  const PlanesOfScans& planes;
  std::vector<std::int64_t> first = {};  // (planes + 1), in `rows`
  std::vector<std::int32_t> rows = {};   // indices of returns by plane, in the order of scans
  std::vector<float> weights = {};       // by return; 0 if only one scan observes its plane
  std::vector<double> taken = {};        // (clusters, 6), reduction of the gradient by marginalising planes

  struct Residual {
    double value;            // distance from the plane, m
    double variance;         // of its noise, m^2
    double along[kPlane];    // minus the derivative by offset and tilts of the plane
    double jacobian[kPose];  // derivative by the increment of the pose
  };

  Residual residual(std::int64_t i) const {
    Residual found;
    const std::int64_t plane = returns.planes[i], scan = returns.scans[i];
    const Vec3 n = vec3(planes.normals, plane), point = vec3(returns.points, i);
    const Vec3 off = point - vec3(planes.centres, plane), arm = point - vec3(returns.positions, scan);
    const auto [e1, e2] = tangents(n);
    found.value = dot(off, n);
    found.along[0] = 1;
    found.along[1] = dot(off, e1) / planes.extent_m;
    found.along[2] = dot(off, e2) / planes.extent_m;
    const Beam beam(returns.ranges_m[i] * vec3(returns.directions, i), vec3(returns.up_of_scan, scan));
    found.variance = beam.variance_along(n, variances_of(returns.noise_of_scan + 3 * scan));
    store(n, found.jacobian);
    store(cross(arm, n), found.jacobian + 3);
    return found;
  }
};

CommonPlanes::CommonPlanes(const PosedReturns& returns, const PlanesOfScans& planes, std::int64_t scans_together,
                           int num_threads)
    : num_scans_(returns.num_scans),
      width_(std::min(scans_together, returns.num_scans) - 1),
      weights_(returns.num_scans),
      diagonal_(kBlock * returns.num_scans),
      gradient_(kPose * returns.num_scans) {
  Input input{returns, planes};
  find_clusters(input);
  find_scale(input, num_threads);
  eliminate_planes(input, num_threads);
  sum_scans(input, num_threads);
}

void CommonPlanes::find_clusters(Input& input) {
  const PosedReturns& returns = input.returns;
  const std::int64_t num_planes = input.planes.count;
  input.first.assign(num_planes + 1, 0);
  for (std::int64_t i = 0; i < returns.count; ++i) {
    if (returns.planes[i] >= 0) ++input.first[returns.planes[i] + 1];
  }
  std::partial_sum(input.first.begin(), input.first.end(), input.first.begin());
  input.rows.resize(input.first.back());
  std::vector<std::int64_t> next(input.first.begin(), input.first.end() - 1);
  for (std::int64_t i = 0; i < returns.count; ++i) {
    if (returns.planes[i] < 0) continue;
    input.rows[next[returns.planes[i]]++] = static_cast<std::int32_t>(i);
  }
  const auto scan = [&](std::int64_t at) { return returns.scans[input.rows[at]]; };
  first_of_plane_.assign(1, 0);
  for (std::int64_t p = 0; p < num_planes; ++p) {
    const std::int64_t begin = input.first[p], end = input.first[p + 1];
    if (begin < end && scan(begin) != scan(end - 1)) {  // a plane of one scan constrains no pose
      for (std::int64_t k = begin; k < end; ++k) {
        if (k > begin && scan(k) == scan(k - 1)) continue;
        plane_of_cluster_.push_back(static_cast<std::int32_t>(p));
        scan_of_cluster_.push_back(scan(k));
      }
    }
    first_of_plane_.push_back(static_cast<std::int64_t>(scan_of_cluster_.size()));
  }
  first_of_scan_.assign(num_scans_ + 1, 0);
  for (const std::int32_t of : scan_of_cluster_) ++first_of_scan_[of + 1];
  std::partial_sum(first_of_scan_.begin(), first_of_scan_.end(), first_of_scan_.begin());
  order_.resize(scan_of_cluster_.size());
  next.assign(first_of_scan_.begin(), first_of_scan_.end() - 1);
  for (std::size_t k = 0; k < order_.size(); ++k) {
    order_[next[scan_of_cluster_[k]]++] = static_cast<std::int32_t>(k);
  }
}

void CommonPlanes::find_scale(const Input& input, int num_threads) {
  std::vector<double> ratios(input.rows.size());
  if (ratios.empty()) return;
  parallel_for(static_cast<std::int64_t>(ratios.size()), 1 << 10, num_threads, [&](std::int64_t k) {
    const Input::Residual found = input.residual(input.rows[k]);
    ratios[k] = found.value * found.value / std::max(found.variance, kLeastM2);
  });
  scale_ = scale_of(ratios);
}

void CommonPlanes::eliminate_planes(Input& input, int num_threads) {
  const std::size_t clusters = scan_of_cluster_.size();
  input.weights.resize(input.returns.count);
  input.taken.resize(kPose * clusters);
  group_end_.resize(clusters);
  coupling_.resize(kCoupling * clusters);
  if (width_ + 1 < num_scans_) band_coupling_.resize(kCoupling * clusters);
  parallel_for(input.planes.count, 1 << 6, num_threads, [&](std::int64_t p) { eliminate_plane(input, p); });
}

void CommonPlanes::eliminate_plane(Input& input, std::int64_t plane) {
  const std::size_t base = first_of_plane_[plane], last = first_of_plane_[plane + 1];
  if (base == last) return;
  std::vector<PlaneSums> sums(last - base);
  std::size_t cluster = base;
  for (std::int64_t k = input.first[plane]; k < input.first[plane + 1]; ++k) {
    const std::int64_t i = input.rows[k];
    if (input.returns.scans[i] != scan_of_cluster_[cluster]) ++cluster;
    const Input::Residual found = input.residual(i);
    const double variance = scale_ * std::max(found.variance, kLeastM2);
    const double share = robust_share(found.value, variance);
    const auto w = static_cast<float>(share * share / variance);
    input.weights[i] = w;
    sums[cluster - base].add(found.along, w, found.value);
    double* c = &coupling_[kCoupling * cluster];
    for (int l = 0; l < kPlane; ++l) {
      for (int a = 0; a < kPose; ++a) c[kPose * l + a] += w * found.along[l] * found.jacobian[a];
    }
  }
  // Within the band, each group of neighbouring scans has its own copy of the plane.
  for (std::size_t group = base, end = base; group < last; group = end) {
    while (end < last && scan_of_cluster_[end] - scan_of_cluster_[group] <= width_) ++end;
    PlaneSums own;
    for (std::size_t k = group; k < end; ++k) {
      group_end_[k] = static_cast<std::int32_t>(end);
      own.add(sums[k - base]);
    }
    if (band_coupling_.empty()) continue;
    own.factor();
    for (std::size_t k = group; k < end; ++k) {
      double* c = &band_coupling_[kCoupling * k];
      std::copy(&coupling_[kCoupling * k], &coupling_[kCoupling * k] + kCoupling, c);
      own.divide(c, kPose);
    }
  }
  PlaneSums all;
  for (const PlaneSums& part : sums) all.add(part);
  all.factor();
  all.divide(all.u, 1);
  for (std::size_t k = base; k < last; ++k) {
    double* c = &coupling_[kCoupling * k];
    all.divide(c, kPose);
    add_transposed_product<kPlane>(c, all.u, &input.taken[kPose * k]);
  }
}

void CommonPlanes::sum_scans(const Input& input, int num_threads) {
  const PosedReturns& returns = input.returns;
  const auto begin_of = [&](std::int64_t scan) {
    return std::lower_bound(returns.scans, returns.scans + returns.count, scan) - returns.scans;
  };
  parallel_for(num_scans_, 1, num_threads, [&](std::int64_t s) {
    double *h = &diagonal_[kBlock * s], *g = &gradient_[kPose * s];
    for (std::int64_t i = begin_of(s); i < begin_of(s + 1); ++i) {
      const double w = input.weights[i];
      if (!(w > 0)) continue;
      const Input::Residual found = input.residual(i);
      const double* j = found.jacobian;
      for (int a = 0; a < kPose; ++a) {
        for (int b = 0; b < kPose; ++b) h[kPose * a + b] += w * j[a] * j[b];
        g[a] += w * j[a] * found.value;
      }
      weights_[s] += w * scale_ * std::max(found.variance, kLeastM2);
    }
    for (std::int64_t k = first_of_scan_[s]; k < first_of_scan_[s + 1]; ++k) {
      const double* taken = &input.taken[kPose * std::int64_t{order_[k]}];
      for (int a = 0; a < kPose; ++a) g[a] -= taken[a];
    }
  });
}

void CommonPlanes::subtract_planes(BlockBand& band, int num_threads) const {
  const std::vector<double>& coupling = band_coupling_.empty() ? coupling_ : band_coupling_;
  // Scans write to disjoint rows.
  parallel_for(num_scans_, 1, num_threads, [&](std::int64_t s) {
    for (std::int64_t k = first_of_scan_[s]; k < first_of_scan_[s + 1]; ++k) {
      const std::size_t own = order_[k];
      // Backwards over the clusters of the group, which share its end.
      for (std::size_t other = own + 1; other-- > 0;) {
        if (group_end_[other] != group_end_[own]) break;
        const double *a = &coupling[kCoupling * own], *b = &coupling[kCoupling * other];
        double* entry = band.block(s, scan_of_cluster_[other]);
        for (int l = 0; l < kPlane; ++l) {
          for (int i = 0; i < kPose; ++i) {
            const double factor = a[kPose * l + i];
            for (int j = 0; j < kPose; ++j) entry[kPose * i + j] -= factor * b[kPose * l + j];
          }
        }
      }
    }
  });
}

void CommonPlanes::apply(const BlockBand& prior, const double* x, double* y, int num_threads) const {
  const std::size_t planes = first_of_plane_.size() - 1;
  std::vector<double> of_plane(kPlane * planes);
  parallel_for(static_cast<std::int64_t>(planes), 1 << 8, num_threads, [&](std::int64_t p) {
    double* z = &of_plane[kPlane * p];
    for (std::int64_t k = first_of_plane_[p]; k < first_of_plane_[p + 1]; ++k) {
      const double *c = &coupling_[kCoupling * k], *own = x + kPose * scan_of_cluster_[k];
      add_product<kPlane>(c, own, z);
    }
  });
  parallel_for(num_scans_, 8, num_threads, [&](std::int64_t s) {
    double* out = y + kPose * s;
    std::fill(out, out + kPose, 0.0);
    add_product<kPose>(&diagonal_[kBlock * s], x + kPose * s, out);
    for (std::int64_t t = prior.first_column(s); t <= s; ++t) add_product<kPose>(prior.block(s, t), x + kPose * t, out);
    for (std::int64_t t = s + 1; t < num_scans_ && prior.first_column(t) <= s; ++t) {
      add_transposed_product<kPose>(prior.block(t, s), x + kPose * t, out);
    }
    for (std::int64_t k = first_of_scan_[s]; k < first_of_scan_[s + 1]; ++k) {
      const std::size_t cluster = order_[k];
      const double *c = &coupling_[kCoupling * cluster],
                   *z = &of_plane[kPlane * std::int64_t{plane_of_cluster_[cluster]}];
      for (int l = 0; l < kPlane; ++l) {
        for (int a = 0; a < kPose; ++a) out[a] -= c[kPose * l + a] * z[l];
      }
    }
  });
}

double CommonPlanes::solve(const BlockBand& prior, const double* q, double tolerance, int max_iterations, double* x,
                           double* inverse_diagonal, double* inverse_below, int num_threads) const {
  BlockBand band(num_scans_, std::max({width_, prior.width(), std::int64_t{1}}));
  for (std::int64_t s = 0; s < num_scans_; ++s) {
    std::copy(prior.block(s, prior.first_column(s)), prior.block(s, s) + kBlock, band.block(s, prior.first_column(s)));
    for (int k = 0; k < kBlock; ++k) band.block(s, s)[k] += diagonal_[kBlock * s + k];
  }
  subtract_planes(band, num_threads);
  if (!band.factor()) throw std::runtime_error("the poses are not determined: their prior must be positive definite");
  if (inverse_diagonal != nullptr) {
    const BlockBand inverse = band.inverse();
    for (std::int64_t s = 0; s < num_scans_; ++s) {
      std::copy(inverse.block(s, s), inverse.block(s, s) + kBlock, inverse_diagonal + kBlock * s);
      if (s > 0) std::copy(inverse.block(s, s - 1), inverse.block(s, s - 1) + kBlock, inverse_below + kBlock * (s - 1));
    }
  }
  const std::size_t numbers = kPose * num_scans_;
  std::vector<double> residual(numbers), direction(numbers), product(numbers), solved(numbers);
  std::fill(x, x + numbers, 0.0);
  for (std::size_t i = 0; i < numbers; ++i) residual[i] = -(gradient_[i] + q[i]);
  solved = residual;
  band.solve(solved.data());
  direction = solved;
  double energy = std::inner_product(residual.begin(), residual.end(), solved.begin(), 0.0);
  const double enough = tolerance * tolerance * energy;
  int iterations = 0;
  while (iterations < max_iterations && energy > enough && energy > 0) {
    check_interrupt();
    apply(prior, direction.data(), product.data(), num_threads);
    const double curvature = std::inner_product(direction.begin(), direction.end(), product.begin(), 0.0);
    if (!(curvature > 0)) break;
    const double step = energy / curvature;
    for (std::size_t i = 0; i < numbers; ++i) {
      x[i] += step * direction[i];
      residual[i] -= step * product[i];
    }
    solved = residual;
    band.solve(solved.data());
    const double next = std::inner_product(residual.begin(), residual.end(), solved.begin(), 0.0);
    for (std::size_t i = 0; i < numbers; ++i) direction[i] = solved[i] + next / energy * direction[i];
    energy = next;
    ++iterations;
  }
  double decrement = 0;
  for (std::size_t i = 0; i < numbers; ++i) decrement -= x[i] * (gradient_[i] + q[i]);
  return decrement;
}

}  // namespace radarsdf
