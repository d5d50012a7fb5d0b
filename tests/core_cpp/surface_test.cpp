// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <set>
#include <stdexcept>
#include <utility>
#include <vector>

#include "helpers.hpp"
#include "surface/marching_cubes.hpp"
#include "surface/mesh_components.hpp"
#include "surface/sparse_lattice.hpp"

using radarsdf::Mesh;

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr std::int64_t kSize = 40;
constexpr std::array<std::int64_t, 3> kShape{kSize, kSize + 3, kSize - 2};
const radarsdf::Lattice kLattice{{0.1, 0.1, 0.1}, {-2, -2.1, -1.9}};

// Distance to the nearest of some spheres (x, y, z, radius), at each sample: positive outside, as in free space.
std::vector<double> spheres(const std::vector<std::array<double, 4>>& all) {
  std::vector<double> volume;
  for (std::int64_t i = 0; i < kShape[0]; ++i) {
    for (std::int64_t j = 0; j < kShape[1]; ++j) {
      for (std::int64_t k = 0; k < kShape[2]; ++k) {
        const double index[] = {static_cast<double>(i), static_cast<double>(j), static_cast<double>(k)};
        double nearest = std::numeric_limits<double>::infinity();
        for (const auto& sphere : all) {
          double squares = 0;
          for (std::size_t axis = 0; axis < 3; ++axis) {
            squares += std::pow(kLattice.origin[axis] + kLattice.spacing[axis] * index[axis] - sphere[axis], 2);
          }
          nearest = std::min(nearest, std::sqrt(squares) - sphere[3]);
        }
        volume.push_back(nearest);
      }
    }
  }
  return volume;
}

using Edge = std::pair<std::int32_t, std::int32_t>;

// How often each directed edge is part of a face.
std::map<Edge, int> edges_of(const Mesh& mesh) {
  std::map<Edge, int> edges;
  for (std::int64_t f = 0; f < mesh.num_faces; ++f) {
    const std::int32_t* face = mesh.faces.get() + 3 * f;
    for (int i = 0; i < 3; ++i) ++edges[{face[i], face[(i + 1) % 3]}];
  }
  return edges;
}

bool is_closed(const Mesh& mesh) {
  const auto edges = edges_of(mesh);
  return std::all_of(edges.begin(), edges.end(), [&](const auto& edge) {
    return edge.second == 1 && edges.count({edge.first.second, edge.first.first}) == 1;
  });
}

std::int64_t euler_characteristic(const Mesh& mesh) {
  return mesh.num_vertices - static_cast<std::int64_t>(edges_of(mesh).size()) / 2 + mesh.num_faces;
}

struct Measures {
  double area = 0, volume = 0;
};

Measures measure(const Mesh& mesh) {
  Measures sum;
  for (std::int64_t f = 0; f < mesh.num_faces; ++f) {
    const double* p[3];
    for (int i = 0; i < 3; ++i) p[i] = mesh.vertices.get() + 3 * mesh.faces[static_cast<std::size_t>(3 * f + i)];
    double cross[3], squares = 0;
    for (int i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      cross[i] = (p[1][j] - p[0][j]) * (p[2][k] - p[0][k]) - (p[1][k] - p[0][k]) * (p[2][j] - p[0][j]);
      squares += cross[i] * cross[i];
      sum.volume += p[0][i] * cross[i] / 6;
    }
    sum.area += std::sqrt(squares) / 2;
  }
  return sum;
}

bool same(const Mesh& a, const Mesh& b) {
  return a.num_vertices == b.num_vertices && a.num_faces == b.num_faces &&
         std::memcmp(a.vertices.get(), b.vertices.get(),
                     sizeof(double) * static_cast<std::size_t>(3 * a.num_vertices)) == 0 &&
         std::memcmp(a.faces.get(), b.faces.get(), sizeof(std::int32_t) * static_cast<std::size_t>(3 * a.num_faces)) ==
             0;
}

// A mesh's triangles by their positions, whatever the order of vertices and faces; each begins with its least vertex.
using Position = std::array<double, 3>;
std::set<std::array<Position, 3>> triangles(const Mesh& mesh) {
  std::set<std::array<Position, 3>> all;
  for (std::int64_t f = 0; f < mesh.num_faces; ++f) {
    std::array<Position, 3> triangle;
    for (std::size_t i = 0; i < 3; ++i) {
      const double* v = mesh.vertices.get() + 3 * mesh.faces[static_cast<std::size_t>(3 * f) + i];
      triangle[i] = {v[0], v[1], v[2]};
    }
    std::rotate(triangle.begin(), std::min_element(triangle.begin(), triangle.end()), triangle.end());
    all.insert(triangle);
  }
  return all;
}

}  // namespace

TEST_CASE("the mesh of a sphere is closed, has its area, and faces free space") {
  const double radius = 1.5;
  const auto volume = spheres({{0.03, -0.02, 0.05, radius}});
  const Mesh mesh = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, 1);
  CHECK(is_closed(mesh));
  CHECK(euler_characteristic(mesh) == 2);
  const Measures found = measure(mesh);
  CHECK(found.area == doctest::Approx(4 * kPi * radius * radius).epsilon(0.01));
  CHECK(found.volume == doctest::Approx(4 * kPi * std::pow(radius, 3) / 3).epsilon(0.01));  // positive: outwards
  for (std::int64_t v = 0; v < mesh.num_vertices; ++v) {
    const double* p = mesh.vertices.get() + 3 * v;
    const double distance = std::sqrt(std::pow(p[0] - 0.03, 2) + std::pow(p[1] + 0.02, 2) + std::pow(p[2] - 0.05, 2));
    REQUIRE(distance == doctest::Approx(radius).epsilon(0.002));
  }
}

TEST_CASE("a level is the surface of another radius") {
  const auto volume = spheres({{0, 0, 0, 1}});
  const Mesh mesh = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0.5, 1);
  CHECK(measure(mesh).area == doctest::Approx(4 * kPi * 1.5 * 1.5).epsilon(0.01));
}

TEST_CASE("meshes of random samples are closed where they do not end") {
  auto volume = test::normal_numbers<float>(12 * 12 * 12, 1, 1);
  for (std::size_t i = 0; i < 12 * 12 * 12; ++i) {
    const bool border = i % 12 % 11 == 0 || i / 12 % 12 % 11 == 0 || i / 144 % 11 == 0;
    if (border) volume[i] = 1;
    if (i % 7 == 0 && !border) volume[i] = 0;  // equal to the level
  }
  const Mesh mesh = radarsdf::marching_cubes_dense(volume.data(), {12, 12, 12}, nullptr, kLattice, 0, 1);
  CHECK(mesh.num_faces > 1000);
  CHECK(is_closed(mesh));
}

TEST_CASE("threads change nothing, and float samples little") {
  const auto volume = spheres({{0, 0, 0, 1.2}, {0.9, 0.2, 0, 0.8}});
  const std::vector<float> rounded(volume.begin(), volume.end());
  const Mesh mesh = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, 1);
  for (const int threads : test::kThreads) {
    CHECK(same(mesh, radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, threads)));
  }
  const Mesh of_floats = radarsdf::marching_cubes_dense(rounded.data(), kShape, nullptr, kLattice, 0, 1);
  CHECK(measure(of_floats).area == doctest::Approx(measure(mesh).area).epsilon(1e-5));
}

TEST_CASE("sparse marching cubes draws what the dense one does") {
  const auto volume = spheres({{0, 0, 0, 1.2}, {0.9, 0.2, 0, 0.8}});
  std::vector<std::int32_t> cells;
  for (std::int32_t i = 0; i + 1 < kShape[0]; ++i) {
    for (std::int32_t j = 0; j + 1 < kShape[1]; ++j) {
      for (std::int32_t k = 0; k + 1 < kShape[2]; ++k) cells.insert(cells.end(), {i, j, k});
    }
  }
  const auto lattice = radarsdf::sparse_lattice(cells.data(), static_cast<std::int64_t>(cells.size()) / 3, 2);
  std::vector<double> values;
  for (std::int64_t c = 0; c < lattice.num_corners; ++c) {
    const std::int32_t* at = lattice.corners.get() + 3 * c;
    values.push_back(volume[static_cast<std::size_t>((at[0] * kShape[1] + at[1]) * kShape[2] + at[2])]);
  }
  const Mesh dense = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, 1);
  const auto sparse = [&](int threads) {
    return radarsdf::marching_cubes_sparse(lattice.corners.get(), values.data(), lattice.num_corners,
                                           lattice.cell_corners.get(), lattice.num_cells, kLattice, 0, threads);
  };
  const Mesh mesh = sparse(1);
  CHECK(mesh.num_vertices == dense.num_vertices);
  CHECK(triangles(mesh) == triangles(dense));
  for (const int threads : test::kThreads) CHECK(same(mesh, sparse(threads)));
}

TEST_CASE("derivatives of the vertices are those of differences, for any number of threads") {
  constexpr std::int64_t size = 7;
  const std::array<std::int64_t, 3> shape{size, size, size};
  const radarsdf::Lattice lattice{{0.5, 2, 0.1}, {-3, 100, 0.25}};
  auto volume = test::normal_numbers<double>(size * size * size, 1, 4);
  for (double& sample : volume) sample += sample > 0 ? 0.2 : -0.2;
  for (std::size_t i = 0; i < volume.size(); i += 20) volume[i] *= 1e-5;  // vertices are kept away from some
  volume[100] = std::nan("");
  volume[111] = std::numeric_limits<double>::infinity();

  // The same cells one by one: all corners, in the order of the samples.
  std::vector<std::int32_t> cells;
  for (std::int32_t i = 0; i + 1 < size; ++i) {
    for (std::int32_t j = 0; j + 1 < size; ++j) {
      for (std::int32_t k = 0; k + 1 < size; ++k) cells.insert(cells.end(), {i, j, k});
    }
  }
  const auto corners = radarsdf::sparse_lattice(cells.data(), static_cast<std::int64_t>(cells.size()) / 3, 1);
  REQUIRE(corners.num_corners == size * size * size);
  const auto mesh_of = [&](bool dense) {
    if (dense) return radarsdf::marching_cubes_dense(volume.data(), shape, nullptr, lattice, 0, 1, true);
    return radarsdf::marching_cubes_sparse(corners.corners.get(), volume.data(), corners.num_corners,
                                           corners.cell_corners.get(), corners.num_cells, lattice, 0, 1, true);
  };
  for (const bool dense : {true, false}) {
    const Mesh mesh = mesh_of(dense);
    REQUIRE(mesh.num_vertices > 300);
    const auto weights = test::normal_numbers<double>(static_cast<std::size_t>(3 * mesh.num_vertices), 1, 5);
    const auto derivative = [&](int threads) {
      std::vector<double> grad(volume.size(), 7);
      if (dense) {
        radarsdf::marching_cubes_dense_backward(volume.data(), shape, mesh.edges.get(), weights.data(),
                                                mesh.num_vertices, lattice.spacing, 0, grad.data(), threads);
      } else {
        radarsdf::marching_cubes_sparse_backward(volume.data(), corners.num_corners, mesh.edges.get(),
                                                 mesh.uppers.get(), weights.data(), mesh.num_vertices, lattice.spacing,
                                                 0, grad.data(), threads);
      }
      return grad;
    };
    const std::vector<double> grad = derivative(1);
    for (const int threads : test::kThreads) CHECK(derivative(threads) == grad);
    const auto moved = [&](std::size_t i, double step) {
      const double kept = volume[i];
      volume[i] += step;
      const Mesh other = mesh_of(dense);
      volume[i] = kept;
      REQUIRE(other.num_vertices == mesh.num_vertices);
      double sum = 0;  // of what moved alone: the origin is far from some vertices
      for (std::size_t v = 0; v < weights.size(); ++v) sum += weights[v] * (other.vertices[v] - mesh.vertices[v]);
      return sum;
    };
    constexpr double step = 1e-7;
    std::int64_t not_zero = 0;
    for (std::size_t i = 0; i < volume.size(); ++i) {
      REQUIRE(grad[i] == doctest::Approx((moved(i, step) - moved(i, -step)) / (2 * step)).epsilon(1e-3));
      not_zero += grad[i] != 0;
    }
    CHECK(not_zero > 200);
    CHECK(grad[100] == 0);
    CHECK(grad[111] == 0);
  }
}

TEST_CASE("a mask and NaN leave out the cells that they touch") {
  auto volume = spheres({{0, 0, 0, 1.2}});
  const auto mask = std::make_unique<bool[]>(volume.size());
  const auto plane = static_cast<std::size_t>(kShape[1] * kShape[2]);
  for (std::size_t i = 0; i < volume.size(); ++i) mask[i] = i < 20 * plane;  // half of the sphere, and a bit
  const Mesh masked = radarsdf::marching_cubes_dense(volume.data(), kShape, mask.get(), kLattice, 0, 1);
  for (std::size_t i = 20 * plane; i < volume.size(); ++i) volume[i] = std::nan("");
  const Mesh cut = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, 1);
  CHECK(same(masked, cut));
  CHECK(!is_closed(cut));
  CHECK(measure(cut).area == doctest::Approx(2 * kPi * 1.2 * 1.1).epsilon(0.01));  // a cap of height 1.1
}

TEST_CASE("two spheres are two components") {
  const auto volume = spheres({{-0.9, 0, 0, 0.7}, {0.9, 0, 0, 0.5}});
  const Mesh mesh = radarsdf::marching_cubes_dense(volume.data(), kShape, nullptr, kLattice, 0, 1);
  CHECK(euler_characteristic(mesh) == 4);
  const auto components = radarsdf::mesh_components(mesh.faces.get(), mesh.num_faces, mesh.num_vertices);
  REQUIRE(components.sizes.size() == 2);
  std::int64_t counts[2] = {};
  for (std::int64_t f = 0; f < mesh.num_faces; ++f) {
    const auto label = static_cast<std::size_t>(components.labels[static_cast<std::size_t>(f)]);
    ++counts[label];
    const double x = mesh.vertices[static_cast<std::size_t>(3 * mesh.faces[static_cast<std::size_t>(3 * f)])];
    REQUIRE((x < 0) == (label == static_cast<std::size_t>(components.labels[0])));  // the first face is on the left
  }
  for (std::size_t i = 0; i < 2; ++i) CHECK(components.sizes[i] == counts[i]);
  const std::int32_t bad[] = {0, 1, 2};
  CHECK_THROWS_AS(radarsdf::mesh_components(bad, 1, 2), std::invalid_argument);
}

TEST_CASE("a sparse lattice has the set of cells and the set of their corners") {
  std::vector<std::int32_t> cells;
  for (const double number : test::normal_numbers<double>(3 * 20000, 8, 3)) {
    cells.push_back(static_cast<std::int32_t>(std::floor(number)));
  }
  using Point = std::array<std::int32_t, 3>;
  std::set<Point> of_cells, of_corners;
  for (std::size_t i = 0; i < cells.size(); i += 3) {
    of_cells.insert({cells[i], cells[i + 1], cells[i + 2]});
    for (int c = 0; c < 8; ++c)
      of_corners.insert({cells[i] + (c >> 2), cells[i + 1] + (c >> 1 & 1), cells[i + 2] + (c & 1)});
  }
  const auto points = [](const std::int32_t* data, std::int64_t count) {
    std::vector<Point> all;
    for (std::int64_t i = 0; i < count; ++i) all.push_back({data[3 * i], data[3 * i + 1], data[3 * i + 2]});
    return all;
  };
  for (const int threads : test::kThreads) {
    const auto lattice = radarsdf::sparse_lattice(cells.data(), static_cast<std::int64_t>(cells.size()) / 3, threads);
    const auto own = points(lattice.cells.get(), lattice.num_cells);
    const auto corners = points(lattice.corners.get(), lattice.num_corners);
    CHECK(own == std::vector<Point>(of_cells.begin(), of_cells.end()));
    CHECK(corners == std::vector<Point>(of_corners.begin(), of_corners.end()));
    for (std::size_t i = 0; i < own.size(); ++i) {
      for (int c = 0; c < 8; ++c) {
        const Point expected{own[i][0] + (c >> 2), own[i][1] + (c >> 1 & 1), own[i][2] + (c & 1)};
        const std::int32_t row = lattice.cell_corners[8 * i + static_cast<std::size_t>(c)];
        REQUIRE(corners[static_cast<std::size_t>(row)] == expected);
      }
    }
  }
}

TEST_CASE("lattices and cells that make no sense are refused") {
  const double volume[8] = {};
  radarsdf::Lattice lattice;
  lattice.spacing[1] = 0;
  CHECK_THROWS_AS(radarsdf::marching_cubes_dense(volume, {2, 2, 2}, nullptr, lattice, 0, 1), std::invalid_argument);
  CHECK_THROWS_AS(radarsdf::marching_cubes_dense(volume, {2, 2, 2}, nullptr, {}, std::nan(""), 1),
                  std::invalid_argument);
  const std::int32_t corners[3] = {}, cells[8] = {0, 0, 0, 0, 0, 0, 0, 1};
  CHECK_THROWS_AS(radarsdf::marching_cubes_sparse(corners, volume, 1, cells, 1, {}, 0, 1), std::invalid_argument);
  const std::int64_t edge[1] = {8 * 3};  // of a ninth sample
  const std::int32_t upper[1] = {0};
  double grad[8];
  CHECK_THROWS_AS(radarsdf::marching_cubes_dense_backward(volume, {2, 2, 2}, edge, volume, 1, {1, 1, 1}, 0, grad, 1),
                  std::invalid_argument);
  CHECK_THROWS_AS(radarsdf::marching_cubes_sparse_backward(volume, 8, edge, upper, volume, 1, {1, 1, 1}, 0, grad, 1),
                  std::invalid_argument);
}
