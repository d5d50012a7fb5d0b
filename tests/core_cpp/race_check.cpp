// Runs every parallel function of the core with more threads than processors, for ThreadSanitizer (tools/test_core.sh
// thread), and compares the results with one thread; then runs all from several threads concurrently, as if each fitted
// its own map.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <thread>
#include <vector>

#include "field/encodings.hpp"
#include "field/mlp.hpp"
#include "field/optimiser.hpp"
#include "helpers.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/morton.hpp"
#include "lattice/vertex_table.hpp"
#include "returns/bridges.hpp"
#include "returns/cell_means.hpp"
#include "returns/cell_sums.hpp"
#include "returns/onto_planes.hpp"
#include "returns/ray_average.hpp"
#include "returns/smooth_distances.hpp"
#include "returns/surface_crossings.hpp"
#include "returns/visibility.hpp"
#include "surface/marching_cubes.hpp"
#include "surface/ray_tracing.hpp"
#include "surface/sparse_lattice.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"
#include "util/sorting.hpp"
#include "util/thread_pool.hpp"

namespace {

using radarsdf::Mesh;

constexpr std::int64_t kPoints = 20000;  // more than a block of most loops
constexpr int kLevels = 3;

// Concatenated bytes of all results.
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
radarsdf::VertexTable table_of(const std::vector<T>& points, radarsdf::Encoding encoding, int threads) {
  radarsdf::CellSet cells(0.2);
  cells.insert(points.data(), kPoints, threads);
  return radarsdf::VertexTable(cells.sorted_keys(threads), 0.2, kLevels, encoding, threads);
}

template <typename T>
void encodings(radarsdf::Encoding encoding, int threads, Results& results) {
  const auto points = test::normal_numbers<T>(3 * kPoints, 4.0, 1);
  const radarsdf::VertexTable table = table_of(points, encoding, threads);
  results.add(table.faces().data(), static_cast<std::int64_t>(table.faces().size()));
  results.add(table.rows().data(), static_cast<std::int64_t>(table.rows().size()));

  const auto features = test::normal_numbers<T>(8 * table.num_rows(), 1.0, 2);
  const auto grad = test::normal_numbers<T>(8 * kLevels * kPoints, 1.0, 3),
             directions = test::normal_numbers<T>(3 * kPoints, 1, 4);
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

// Two steps of Adam, as in a fit.
void adam(radarsdf::Encoding encoding, int threads, Results& results) {
  const auto points = test::normal_numbers<float>(3 * kPoints, 4.0, 1);
  const radarsdf::VertexTable table = table_of(points, encoding, threads);
  auto features = test::normal_numbers<float>(8 * table.num_rows(), 1.0, 2);
  const auto grad = test::normal_numbers<float>(8 * kLevels * kPoints, 1.0, 3);
  std::vector<std::int32_t> located(kLevels * kPoints);
  std::vector<radarsdf::RowState> states(features.size() / 8);
  radarsdf::locate(table, points.data(), kPoints, located.data(), threads);
  const std::vector<float> decays{1, 1, 0.9F, 0.99F, 0.81F, 0.98F};
  const radarsdf::PointBatch<float> batch{points.data(), nullptr, located.data(), kPoints};
  for (std::int32_t step = 1; step <= 2; ++step) {
    const radarsdf::AdamStep adam{features.data(), states.data(), decays.data(), step, 0.01F, 1.0F, 1e-8F};
    radarsdf::ThreadPool pool(threads);
    pool.run(radarsdf::num_level_tasks(table), [&](std::int64_t task) {
      radarsdf::adam_task(table, batch, grad.data(), 8 * kLevels, adam, radarsdf::level_task(table, task));
    });
  }
  results.add(features.data(), 8 * table.num_rows());
  results.add(states.data(), table.num_rows());
}

// Forward and backward pass of a network with two layers and two blocks of inputs.
template <typename T>
void networks(int threads, Results& results) {
  constexpr std::int64_t kHidden = 20, kWide = 7, kNarrow = 5, kOutputs = 3;
  const auto wide = test::normal_numbers<T>(kWide * kPoints, 1.0, 11),
             narrow = test::normal_numbers<T>(kNarrow * kPoints, 1.0, 12);
  const auto first = test::normal_numbers<T>(kHidden * (kWide + kNarrow + 1), 0.3, 13);
  const auto second = test::normal_numbers<T>(kOutputs * (kHidden + 1), 0.3, 14);
  const auto grad = test::normal_numbers<T>(kOutputs * kPoints, 1.0, 15);
  const std::vector<radarsdf::Layer<T>> layers = {
      {first.data(), first.data() + kHidden * (kWide + kNarrow), kWide + kNarrow, kHidden},
      {second.data(), second.data() + kOutputs * kHidden, kHidden, kOutputs}};
  const std::vector<radarsdf::Columns<const T>> inputs = {{wide.data(), kWide, kWide},
                                                          {narrow.data(), kNarrow, kNarrow}};
  std::vector<T> hidden(radarsdf::mlp_hidden_columns(layers) * kPoints);
  std::vector<T> out(grad.size()), first_grad(first.size()), second_grad(second.size()), wide_grad(wide.size());
  radarsdf::mlp(radarsdf::ForwardWeights<T>(layers), inputs, kPoints, hidden.data(), out.data(), threads);
  const radarsdf::BackwardWeights<T> backward(layers, {{kWide, true}, {kNarrow, false}});
  radarsdf::mlp_backward<T>(backward, inputs, kPoints, hidden.data(), {grad.data(), kOutputs, kOutputs},
                            {{first_grad.data(), first_grad.data() + kHidden * (kWide + kNarrow)},
                             {second_grad.data(), second_grad.data() + kOutputs * kHidden}},
                            {{wide_grad.data(), kWide, kWide}, {nullptr, 0, kNarrow}}, threads);
  for (const std::vector<T>* numbers : {&out, &first_grad, &second_grad, &wide_grad}) {
    results.add(numbers->data(), static_cast<std::int64_t>(numbers->size()));
  }
}

// Sums over cells, and rays that cross surfels and cells.
void sums_and_rays(int threads, Results& results) {
  const auto points = test::normal_numbers<float>(3 * kPoints, 3.0, 9);
  auto directions = test::normal_numbers<float>(3 * kPoints, 1.0, 10);
  for (std::int64_t i = 0; i < kPoints; ++i) {
    float* d = directions.data() + 3 * i;
    const float length = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int axis = 0; axis < 3; ++axis) d[axis] /= length;
  }
  std::vector<std::uint64_t> keys(kPoints);
  radarsdf::cell_keys(points.data(), kPoints, 0.4, keys.data(), threads);
  std::vector<std::uint64_t> sorted = keys;
  radarsdf::parallel_sort(sorted, threads);
  sorted.erase(std::unique(sorted.begin(), sorted.end()), sorted.end());
  results.add(sorted.data(), static_cast<std::int64_t>(sorted.size()));
  const auto num_cells = static_cast<std::int64_t>(sorted.size());

  const radarsdf::CellBlocks blocks(sorted.data(), num_cells);
  std::vector<std::int32_t> rows(kPoints);
  blocks.rows(keys.data(), kPoints, rows.data(), threads);
  results.add(rows.data(), kPoints);
  const std::vector<float> ranges(kPoints, 6.0F);
  std::vector<std::int64_t> sums(radarsdf::kSums * num_cells);
  radarsdf::sum_returns({points.data(), directions.data(), ranges.data(), rows.data(), kPoints}, sorted.data(),
                        num_cells, 0.4, sums.data(), threads);
  const std::vector<double> values(sums.begin(), sums.end());
  std::vector<double> round(values.size());
  radarsdf::neighbour_sums(blocks, sorted.data(), num_cells, values.data(), radarsdf::kSums, 0.5, round.data(),
                           threads);
  results.add(values.data(), radarsdf::kSums * num_cells);
  results.add(round.data(), radarsdf::kSums * num_cells);

  std::vector<radarsdf::Surfel> surfels;
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    const double* m = values.data() + radarsdf::kSums * cell;
    const std::uint64_t key = sorted[cell];
    const auto mean = [&](int axis) {
      const double in_cell = m[1 + axis] / (m[0] * static_cast<double>(radarsdf::kQuanta));
      return static_cast<float>(0.4 * (radarsdf::morton_coordinate(key, axis) + in_cell - radarsdf::kAxisBias));
    };
    surfels.push_back({{mean(0), mean(1), mean(2)}, {0, 0, 1}, 0.05F, 0.3F});
  }
  const radarsdf::SurfelMap map(sorted.data(), surfels.data(), num_cells, 0.4);
  std::vector<std::int32_t> crossed(kPoints);
  map.first_crossings(points.data(), directions.data(), ranges.data(), kPoints, {0.1F, 0.01F}, 0.1F, 2.0F,
                      crossed.data(), threads);
  if (std::all_of(crossed.begin(), crossed.end(), [](std::int32_t c) { return c < 0; })) std::abort();
  results.add(crossed.data(), kPoints);

  std::vector<std::int32_t> scans(kPoints);
  for (std::size_t i = 0; i < kPoints; ++i) scans[i] = static_cast<std::int32_t>(i / 300);
  std::vector<std::uint32_t> scans_of_cell(sorted.size());
  radarsdf::count_scans(rows.data(), scans.data(), kPoints, num_cells, scans_of_cell.data(), threads);
  results.add(scans_of_cell.data(), num_cells);

  radarsdf::CellSet along(0.2);
  along.insert_rays(points.data(), directions.data(), kPoints, 0.4, threads);
  const std::vector<std::uint64_t> leaf_keys = along.sorted_keys(threads);
  const auto num_leaves = static_cast<std::int64_t>(leaf_keys.size());
  std::vector<std::uint32_t> visibility(leaf_keys.size());
  radarsdf::count_visibility(leaf_keys.data(), num_leaves, 0.2, points.data(), directions.data(), ranges.data(),
                             scans.data(), kPoints, visibility.data(), threads);
  results.add(visibility.data(), num_leaves);
  const radarsdf::VertexTable table(leaf_keys, 0.2, 1, radarsdf::Encoding::kOctree, threads);
  std::vector<float> weights(kPoints, 1.0F), distances(static_cast<std::size_t>(table.num_rows()));
  std::vector<std::int8_t> sides(distances.size());
  radarsdf::average_rays(table, {points.data(), directions.data(), directions.data(), weights.data(), kPoints}, 0.6,
                         distances.data(), sides.data(), threads);
  radarsdf::smooth_distances(table, {points.data(), directions.data(), weights.data(), kPoints}, sides.data(), 3,
                             distances.data(), threads);
  results.add(distances.data(), table.num_rows());
}

// Means in cells, and rays through a triangle soup.
void means_and_tracing(int threads, Results& results) {
  const auto points = test::normal_numbers<float>(3 * kPoints, 3.0, 11),
             directions = test::normal_numbers<float>(3 * kPoints, 0.6, 12),
             values = test::normal_numbers<float>(kPoints, 1.0, 13);
  const radarsdf::Views views{points.data(), directions.data(), values.data(), kPoints};
  const std::vector<radarsdf::CellKind> kinds{{1.0, 0.2, 0.0}, {2.0, 0.0, 0.5}};
  const std::vector<float> weights(kPoints, 1.0F);
  const auto means = radarsdf::fit_cell_means(kinds, 3, views, values.data(), weights.data(), {2.0, 2, 0}, threads);
  const auto num_means = static_cast<std::int64_t>(means.keys.size());
  results.add(means.explained.data(), kPoints);
  std::vector<float> numbers(kPoints);
  radarsdf::CellMeansAt(kinds, 3, means.keys.data(), means.means.data(), num_means)
      .sums(views, numbers.data(), threads);
  results.add(numbers.data(), kPoints);

  const auto vertices = test::normal_numbers<double>(3 * kPoints, 3.0, 14);
  std::vector<std::int32_t> faces(kPoints / 3 * 3);
  for (std::size_t i = 0; i < faces.size(); ++i) faces[i] = static_cast<std::int32_t>(i);
  const radarsdf::SurfaceTracer tracer(vertices.data(), kPoints, faces.data(), kPoints / 3, threads);
  const double origin[3] = {0.1, 0.2, 0.3};
  std::vector<std::int32_t> hits(kPoints);
  tracer.first_hits(origin, directions.data(), kPoints, 50.0, false, numbers.data(), hits.data(), threads);
  if (std::all_of(hits.begin(), hits.end(), [](std::int32_t hit) { return hit < 0; })) std::abort();
  results.add(numbers.data(), kPoints);
  results.add(hits.data(), kPoints);
}

// Returns shrunk towards planes, cells along rays, and bridges.
void before_the_training(int threads, Results& results) {
  const auto points = test::normal_numbers<float>(3 * kPoints, 3.0, 16);
  const auto directions = test::normal_numbers<float>(3 * kPoints, 1.0, 17);
  const auto offsets = test::normal_numbers<float>(5, 0.3, 18);
  radarsdf::CellSet cells(0.2);
  cells.insert_along(points.data(), directions.data(), kPoints, offsets.data(), 5, threads);
  const std::vector<std::uint64_t> keys = cells.sorted_keys(threads);
  const auto num_keys = static_cast<std::int64_t>(keys.size());
  results.add(keys.data(), num_keys);
  std::vector<std::uint64_t> ends;
  for (std::size_t i = 0; i < keys.size(); i += 3) ends.push_back(keys[i]);
  const std::vector<double> support(ends.size(), 1.0);
  const std::vector<std::uint64_t> bridged = radarsdf::bridge_cells(
      keys.data(), num_keys, ends.data(), support.data(), static_cast<std::int64_t>(ends.size()), 4, 9.0, threads);
  results.add(bridged.data(), static_cast<std::int64_t>(bridged.size()));
  std::vector<double> around(keys.size()), ones;
  ones.assign(keys.size(), 1.0);
  radarsdf::neighbour_sums(radarsdf::CellBlocks(keys.data(), num_keys), keys.data(), num_keys, ones.data(), 1, 1.0,
                           around.data(), threads);
  results.add(around.data(), num_keys);

  constexpr std::int64_t kPlanes = 300, kScans = 7;
  const auto planes = test::normal_numbers<double>(7 * kPlanes, 1.0, 19),
             up = test::normal_numbers<double>(3 * kScans, 1.0, 20), noise = std::vector<double>(3 * kScans, 1e-4);
  const std::vector<float> ranges(kPoints, 6.0F);
  std::vector<std::int32_t> scans(kPoints), of_return(kPoints);
  for (std::int32_t i = 0; i < kPoints; ++i) {
    scans[i] = static_cast<std::int32_t>(i * kScans / kPoints);
    of_return[i] = static_cast<std::int32_t>(i % (kPlanes + 1) - 1);
  }
  std::vector<float> moved(7 * kPoints);
  radarsdf::move_onto_planes({points.data(), directions.data(), ranges.data(), scans.data(), of_return.data(), nullptr,
                              kPoints, up.data(), noise.data()},
                             {planes.data(), planes.data() + 3 * kPlanes, planes.data() + 6 * kPlanes, kPlanes},
                             {moved.data(), moved.data() + 3 * kPoints, moved.data() + 6 * kPoints}, threads);
  results.add(moved.data(), 7 * kPoints);
}

// The exception of a task cancels the others and reaches the caller.
void failure(int threads) {
  bool caught = false;
  try {
    radarsdf::parallel_tasks(100, threads, [](std::int64_t task) {
      if (task % 10 == 7) throw std::runtime_error("seven");
    });
  } catch (const std::runtime_error&) {
    caught = true;
  }
  if (!caught) std::abort();
}

template <typename T>
void surfaces(int threads, Results& results) {
  const std::array<std::int64_t, 3> shape{40, 33, 47};
  const std::int64_t size = shape[0] * shape[1] * shape[2];
  auto volume = test::normal_numbers<T>(size, 1.0, 5);
  const auto chosen = test::normal_numbers<float>(size, 1.0, 6);
  const auto mask = std::make_unique<bool[]>(static_cast<std::size_t>(size));
  for (std::int64_t i = 0; i < size; ++i) mask[i] = chosen[i] > -2;
  volume[1000] = static_cast<T>(NAN);
  const radarsdf::Lattice lattice;
  results.add(radarsdf::marching_cubes_dense(volume.data(), shape, nullptr, lattice, 0.1, threads));
  results.add(radarsdf::marching_cubes_dense(volume.data(), shape, mask.get(), lattice, 0.1, threads));

  std::vector<std::int32_t> cells;
  for (const float number : test::normal_numbers<float>(3 * 60000, 15.0, 7))
    cells.push_back(static_cast<std::int32_t>(number));
  const auto sparse = radarsdf::sparse_lattice(cells.data(), static_cast<std::int64_t>(cells.size()) / 3, threads);
  const auto values = test::normal_numbers<T>(sparse.num_corners, 1.0, 8);
  results.add(sparse.cells.get(), 3 * sparse.num_cells);
  results.add(sparse.corners.get(), 3 * sparse.num_corners);
  results.add(sparse.cell_corners.get(), 8 * sparse.num_cells);
  results.add(radarsdf::marching_cubes_sparse(sparse.corners.get(), values.data(), sparse.num_corners,
                                              sparse.cell_corners.get(), sparse.num_cells, lattice, 0.0, threads));
}

template <typename T>
void in_both_precisions(int threads, Results& results) {
  encodings<T>(radarsdf::Encoding::kTriQuadtree, threads, results);
  encodings<T>(radarsdf::Encoding::kOctree, threads, results);
  networks<T>(threads, results);
  surfaces<T>(threads, results);
}

Results all(int threads) {
  Results results;
  in_both_precisions<float>(threads, results);
  in_both_precisions<double>(threads, results);
  adam(radarsdf::Encoding::kTriQuadtree, threads, results);
  adam(radarsdf::Encoding::kOctree, threads, results);
  before_the_training(threads, results);
  sums_and_rays(threads, results);
  means_and_tracing(threads, results);
  failure(threads);
  return results;
}

}  // namespace

int main() {
  static std::atomic<int> checks{0};
  radarsdf::set_interrupt_check([] { ++checks; });
  Results alone;
  for (const auto isa : radarsdf::available_instruction_sets()) {
    radarsdf::set_instruction_set(isa);
    alone = all(1);
    const bool same = all(7) == alone;
    std::printf("%s: %s\n", radarsdf::instruction_set_name(isa), same ? "same bits" : "OTHER BITS");
    if (!same) return EXIT_FAILURE;
  }
  std::vector<Results> found(2);
  std::vector<std::thread> callers;
  for (Results& results : found) callers.emplace_back([&results] { results = all(2); });
  for (std::thread& caller : callers) caller.join();
  const bool same = found[0] == alone && found[1] == alone;
  std::printf("two callers at once: %s; asked %d times for interrupts\n", same ? "same bits" : "OTHER BITS",
              checks.load());
  if (!same || checks == 0) return EXIT_FAILURE;
  return EXIT_SUCCESS;
}
