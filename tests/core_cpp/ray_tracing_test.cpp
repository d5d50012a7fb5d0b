// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "surface/ray_tracing.hpp"

#include <doctest/doctest.h>

#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <vector>

#include "helpers.hpp"

namespace {

using Vector = std::array<double, 3>;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Triangles {
  std::vector<double> vertices;
  std::vector<std::int32_t> faces;

  std::int64_t size() const { return static_cast<std::int64_t>(faces.size()) / 3; }
  radarsdf::SurfaceTracer tracer(int threads = 1) const {
    return {vertices.data(), static_cast<std::int64_t>(vertices.size()) / 3, faces.data(), size(), threads};
  }
  Vector corner(std::int64_t face, int i) const {
    const double* v = vertices.data() + 3 * faces[static_cast<std::size_t>(3 * face + i)];
    return {v[0], v[1], v[2]};
  }
};

Triangles one(const Vector& a, const Vector& b, const Vector& c) {
  return {{a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]}, {0, 1, 2}};
}

// Triangles of about this size that lie anywhere within some metres.
Triangles soup(std::int64_t count, double size_m) {
  const auto places = test::normal_numbers<double>(3 * count, 3, 1);
  Triangles triangles{test::normal_numbers<double>(9 * count, size_m, 2), {}};
  for (std::size_t i = 0; i < triangles.vertices.size(); ++i) triangles.vertices[i] += places[i / 9 * 3 + i % 3];
  triangles.faces.resize(static_cast<std::size_t>(3 * count));
  std::iota(triangles.faces.begin(), triangles.faces.end(), 0);
  return triangles;
}

// a · (b × c)
double volume(const Vector& a, const Vector& b, const Vector& c) {
  return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
}

Vector difference(const Vector& a, const Vector& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }

// By the definition: the ray is within the three sides of the pyramid of a triangle. `certain` is false where it passes
// so near an edge that rounding decides.
struct Crossing {
  double range_m = kInfinity;
  bool certain = true;
};

Crossing crossing(const Triangles& mesh, std::int64_t face, const Vector& origin, const Vector& d, bool front_only) {
  const Vector a = difference(mesh.corner(face, 0), origin), b = difference(mesh.corner(face, 1), origin),
               c = difference(mesh.corner(face, 2), origin);
  const double sides[3] = {volume(d, b, a), volume(d, c, b), volume(d, a, c)};
  bool front = true, back = !front_only, certain = true;
  for (const double side : sides) {
    front = front && side > 0;
    back = back && side < 0;
    certain = certain && std::abs(side) > 1e-4;
  }
  const double sum = sides[0] + sides[1] + sides[2];
  if (!front && !back) return {kInfinity, certain};
  return {volume(a, c, b) / sum, certain};
}

struct Hits {
  std::vector<float> ranges_m;
  std::vector<std::int32_t> faces;
  bool operator==(const Hits& other) const { return ranges_m == other.ranges_m && faces == other.faces; }
};

Hits hits(const radarsdf::SurfaceTracer& tracer, const Vector& origin, const std::vector<float>& directions,
          double max_range_m = 100, bool front_only = false, int threads = 1) {
  const std::size_t count = directions.size() / 3;
  Hits found{std::vector<float>(count, -7), std::vector<std::int32_t>(count, -7)};
  tracer.first_hits(origin.data(), directions.data(), static_cast<std::int64_t>(count), max_range_m, front_only,
                    found.ranges_m.data(), found.faces.data(), threads);
  return found;
}

// Where one ray meets a mesh.
double range(const Triangles& mesh, const Vector& origin, const std::vector<float>& direction, double max_range_m = 100,
             bool front_only = false) {
  return double{hits(mesh.tracer(), origin, direction, max_range_m, front_only).ranges_m[0]};
}

}  // namespace

TEST_CASE("a ray stops at the first of many triangles") {
  constexpr std::size_t kRays = 1000;
  const auto directions = test::unit_vectors<float>(kRays, 3);
  for (const double size_m : {0.5, 1.5}) {
    const Triangles mesh = soup(500, size_m);
    for (const Vector& origin : {Vector{0, 0, 0}, Vector{7, -5, 2}}) {
      for (const bool front_only : {false, true}) {
        const Hits found = hits(mesh.tracer(), origin, directions, 9, front_only);
        int met = 0, compared = 0;
        for (std::size_t i = 0; i < kRays; ++i) {
          const Vector d{double{directions[3 * i]}, double{directions[3 * i + 1]}, double{directions[3 * i + 2]}};
          Crossing first;
          std::int32_t face = -1;
          for (std::int64_t f = 0; f < mesh.size(); ++f) {
            const Crossing own = crossing(mesh, f, origin, d, front_only);
            first.certain = first.certain && own.certain;
            if (own.range_m < first.range_m && own.range_m >= 0 && own.range_m <= 9) {
              first.range_m = own.range_m;
              face = static_cast<std::int32_t>(f);
            }
          }
          if (!first.certain) continue;
          ++compared;
          met += face >= 0 ? 1 : 0;
          REQUIRE(found.faces[i] == face);
          if (face >= 0) REQUIRE(std::abs(double{found.ranges_m[i]} - first.range_m) < 1e-5);
          if (face < 0) REQUIRE(found.ranges_m[i] == static_cast<float>(kInfinity));
        }
        CHECK(compared > 700);
        CHECK(met > 20);
      }
    }
  }
}

TEST_CASE("the same bits with any number of threads") {
  const Triangles mesh = soup(3000, 0.3);
  const auto directions = test::unit_vectors<float>(20000, 4);
  const Hits expected = hits(mesh.tracer(), {0, 0, 0}, directions);
  for (const int threads : test::kThreads) {
    CHECK(hits(mesh.tracer(threads), {0, 0, 0}, directions, 100, false, threads) == expected);
  }
}

TEST_CASE("rays along the axes, at the edges of triangles and of boxes") {
  for (int axis = 0; axis < 3; ++axis) {
    for (const double side : {1.0, -1.0}) {
      Vector corners[3] = {};  // of a right angle, whose edges are along the two other axes
      const auto next = static_cast<std::size_t>((axis + 1) % 3), last = static_cast<std::size_t>((axis + 2) % 3);
      for (Vector& corner : corners) corner[static_cast<std::size_t>(axis)] = 5 * side;
      corners[1][next] = corners[2][last] = 2;
      const Triangles mesh = one(corners[0], corners[1], corners[2]);
      std::vector<float> ray(3, 0.0F);
      ray[static_cast<std::size_t>(axis)] = static_cast<float>(side);
      Vector origin{};
      CHECK(range(mesh, origin, ray) == 5);  // through the corner
      origin[next] = 1;
      CHECK(range(mesh, origin, ray) == 5);  // through an edge
      origin[last] = 1;
      CHECK(range(mesh, origin, ray) == 5);  // through the other
      origin[last] = 1.001;
      CHECK(range(mesh, origin, ray) == kInfinity);
      origin[last] = -0.001;
      CHECK(range(mesh, origin, ray) == kInfinity);
      // The front alone: from where corners are counter-clockwise, which is the far side for a positive one.
      origin[last] = 0.5;
      CHECK(range(mesh, origin, ray, 100, true) == (side < 0 ? 5 : kInfinity));
    }
  }
}

TEST_CASE("a ray in the plane of a triangle passes it, one that begins on a triangle has met it") {
  const Triangles mesh = one({-1, -1, 0}, {1, -1, 0}, {0, 1, 0});
  CHECK(range(mesh, {-5, 0, 0}, {1, 0, 0}) == kInfinity);
  CHECK(range(mesh, {0, 0, 0}, {1, 0, 0}) == kInfinity);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}) == 0);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, -1}) == 0);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, -1}, 100, true) == 0);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}, 100, true) == kInfinity);
  CHECK(range(mesh, {3, 0, 0}, {0, 0, 1}) == kInfinity);
  // A triangle without area stops nothing.
  CHECK(range(one({-1, 0, 5}, {1, 0, 5}, {2, 0, 5}), {0, 0, 0}, {0, 0, 1}) == kInfinity);
  CHECK(range(one({0, 0, 5}, {0, 0, 5}, {0, 0, 5}), {0, 0, 0}, {0, 0, 1}) == kInfinity);
}

TEST_CASE("a triangle at the limit is met, one behind it is not") {
  const Triangles mesh = one({-1, -1, 5}, {1, -1, 5}, {0, 1, 5});
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}, 5) == 5);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}, 4.9999) == kInfinity);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}, 0) == kInfinity);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 1}, kInfinity) == 5);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, -1}) == kInfinity);
  CHECK(range(mesh, {0, 0, 0}, {0, 0, 0}) == kInfinity);  // no direction
}

TEST_CASE("no triangles, no rays, and numbers that are none") {
  const std::vector<float> ahead{1, 0, 0};
  const Hits none = hits(Triangles{}.tracer(), {0, 0, 0}, ahead);
  CHECK(none.ranges_m[0] == static_cast<float>(kInfinity));
  CHECK(none.faces[0] == -1);
  CHECK(Triangles{}.tracer().num_bytes() == 0);

  Triangles mesh = one({5, -1, -1}, {5, 1, -1}, {5, 0, 1});
  CHECK(hits(mesh.tracer(), {0, 0, 0}, {}).faces.empty());
  CHECK(range(mesh, {0, 0, 0}, ahead) == 5);
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  for (const double wrong : {kNan, kInfinity, -kInfinity}) {
    CHECK_THROWS_AS(range(mesh, {0, wrong, 0}, ahead), std::invalid_argument);
    CHECK_THROWS_AS(range(mesh, {0, 0, 0}, {1, static_cast<float>(wrong), 0}), std::invalid_argument);
    Triangles broken = mesh;
    broken.vertices[4] = wrong;
    CHECK_THROWS_AS(broken.tracer(), std::invalid_argument);
  }
  CHECK_THROWS_AS(range(mesh, {0, 0, 0}, ahead, -1), std::invalid_argument);
  CHECK_THROWS_AS(range(mesh, {0, 0, 0}, ahead, kNan), std::invalid_argument);
  for (const std::int32_t wrong : {-1, 3}) {
    mesh.faces[1] = wrong;
    CHECK_THROWS_AS(mesh.tracer(), std::invalid_argument);
  }
}
