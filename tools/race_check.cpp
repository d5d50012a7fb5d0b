// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Every parallel function of the core on more threads than there are processors, for ThreadSanitizer
// (tools/sanitize.sh thread), and the same results as on one thread.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <random>
#include <vector>

#include "cell_set.hpp"
#include "encodings.hpp"
#include "instruction_set.hpp"
#include "marching_cubes.hpp"
#include "sparse_lattice.hpp"
#include "vertex_table.hpp"

namespace {

using radarsdf::Mesh;

constexpr std::int64_t kPoints = 40000;
constexpr int kLevels = 3;

// Bytes of all results, one after the other.
class Results {
 public:
  template <typename T>
  void add(const T* data, std::int64_t size) {
    const auto* begin = reinterpret_cast<const unsigned char*>(data);
    bytes_.insert(bytes_.end(), begin, begin + static_cast<std::size_t>(size) * sizeof(T));
  }
  void add(const Mesh& mesh) {
    add(mesh.vertices.get(), 3 * mesh.num_vertices);
    add(mesh.faces.get(), 3 * mesh.num_faces);
  }
  bool operator==(const Results& other) const { return bytes_ == other.bytes_; }

 private:
  std::vector<unsigned char> bytes_;
};

template <typename T>
std::vector<T> random_numbers(std::int64_t size, double scale, unsigned seed) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal(0.0, scale);
  std::vector<T> numbers(static_cast<std::size_t>(size));
  for (T& number : numbers) number = static_cast<T>(normal(generator));
  return numbers;
}

template <typename T>
void encodings(radarsdf::Encoding encoding, int threads, Results& results) {
  const auto points = random_numbers<T>(3 * kPoints, 4.0, 1);
  radarsdf::CellSet cells(0.2);
  cells.insert(points.data(), kPoints, threads);
  const radarsdf::VertexTable table(cells.sorted_keys(threads), 0.2, kLevels, encoding, threads);
  results.add(table.cells().data(), table.num_cells());

  const auto features = random_numbers<T>(8 * table.num_rows(), 1.0, 2);
  const auto grad = random_numbers<T>(8 * kLevels * kPoints, 1.0, 3), directions = random_numbers<T>(3 * kPoints, 1, 4);
  std::vector<std::int32_t> located(kLevels * kPoints), found(kLevels * kPoints);
  std::vector<T> out(grad.size()), points_grad(points.size()), features_grad(features.size());
  const std::int64_t stride = 8 * kLevels;
  radarsdf::locate(table, points.data(), kPoints, found.data(), threads);
  radarsdf::encode(table, features.data(), points.data(), kPoints, located.data(), out.data(), stride, threads);
  results.add(found.data(), kLevels * kPoints);
  results.add(out.data(), stride * kPoints);
  for (const T* direction : {static_cast<const T*>(nullptr), directions.data()}) {
    const radarsdf::PointBatch<T> batch{points.data(), direction, located.data(), kPoints};
    radarsdf::interpolate(table, features.data(), batch, out.data(), stride, threads);
    radarsdf::scatter(table, batch, grad.data(), stride, features_grad.data(), threads);
    radarsdf::coordinate_gradient(table, features.data(), batch, grad.data(), stride, points_grad.data(), threads);
    results.add(out.data(), stride * kPoints);
    results.add(features_grad.data(), 8 * table.num_rows());
    results.add(points_grad.data(), 3 * kPoints);
  }
  std::vector<T> waves(kPoints * 6 * 10), harmonics(kPoints * 16);
  radarsdf::fourier(points.data(), kPoints, 409.6, 0, 10, waves.data(), 60, threads);
  radarsdf::spherical_harmonics(directions.data(), kPoints, harmonics.data(), 16, threads);
  results.add(waves.data(), kPoints * 60);
  results.add(harmonics.data(), kPoints * 16);
}

template <typename T>
void surfaces(int threads, Results& results) {
  const std::array<std::int64_t, 3> shape{40, 33, 47};
  const std::int64_t size = shape[0] * shape[1] * shape[2];
  auto volume = random_numbers<T>(size, 1.0, 5);
  const auto chosen = random_numbers<float>(size, 1.0, 6);
  const auto mask = std::make_unique<bool[]>(static_cast<std::size_t>(size));
  for (std::int64_t i = 0; i < size; ++i) mask[static_cast<std::size_t>(i)] = chosen[static_cast<std::size_t>(i)] > -2;
  volume[1000] = static_cast<T>(NAN);
  const radarsdf::Lattice lattice;
  results.add(radarsdf::marching_cubes_dense(volume.data(), shape, nullptr, lattice, 0.1, threads));
  results.add(radarsdf::marching_cubes_dense(volume.data(), shape, mask.get(), lattice, 0.1, threads));

  std::vector<std::int32_t> cells;
  for (const float number : random_numbers<float>(3 * 60000, 15.0, 7))
    cells.push_back(static_cast<std::int32_t>(number));
  const auto sparse = radarsdf::sparse_lattice(cells.data(), static_cast<std::int64_t>(cells.size()) / 3, threads);
  const auto values = random_numbers<T>(sparse.num_corners, 1.0, 8);
  results.add(sparse.cells.get(), 3 * sparse.num_cells);
  results.add(sparse.corners.get(), 3 * sparse.num_corners);
  results.add(sparse.cell_corners.get(), 8 * sparse.num_cells);
  results.add(radarsdf::marching_cubes_sparse(sparse.corners.get(), values.data(), sparse.num_corners,
                                              sparse.cell_corners.get(), sparse.num_cells, lattice, 0.0, threads));
}

template <typename T>
Results all(int threads) {
  Results results;
  encodings<T>(radarsdf::Encoding::kTriQuadtree, threads, results);
  encodings<T>(radarsdf::Encoding::kOctree, threads, results);
  surfaces<T>(threads, results);
  return results;
}

}  // namespace

int main() {
  for (const auto isa : radarsdf::available_instruction_sets()) {
    radarsdf::set_instruction_set(isa);
    for (const int threads : {2, 4}) {
      const bool same = all<float>(threads) == all<float>(1) && all<double>(threads) == all<double>(1);
      std::printf("%s, %d threads: %s\n", radarsdf::instruction_set_name(isa), threads,
                  same ? "same bits" : "OTHER BITS");
      if (!same) return EXIT_FAILURE;
    }
  }
  return EXIT_SUCCESS;
}
