// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/smooth_distances.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <utility>
#include <vector>

#include "kernels/plate_kernels.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/morton.hpp"
#include "util/instruction_set.hpp"
#include "util/large_array.hpp"
#include "util/parallel.hpp"
#include "util/stable_order.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kBlocks = 1 << 8, kCells = 1 << 12, kPlacesOfThread = 1 << 13;  // of a thread, at least
constexpr int kPlaces = 3;       // of a plane where its distance is known
constexpr double kBend = 2;      // leaf cells: second difference of a distance whose slope turns from -1 to 1
constexpr double kClear = 0.25;  // leaf cells: least distance of a vertex whose side is known
constexpr int kEdge = 4;         // of a block of vertices

// Position of a vertex in its block, from that of Morton order.
constexpr std::array<std::uint8_t, kPlateVertices> linear_positions() {
  std::array<std::uint8_t, kPlateVertices> positions{};
  for (unsigned i = 0; i < kPlateVertices; ++i) {
    unsigned position = 0;
    for (unsigned axis = 0; axis < 3; ++axis) position += ((i >> axis & 1) + 2 * (i >> (axis + 3) & 1)) << (2 * axis);
    positions[i] = static_cast<std::uint8_t>(position);
  }
  return positions;
}
constexpr std::array<std::uint8_t, kPlateVertices> kPosition = linear_positions();

class Plates {
 public:
  Plates(const VertexTable& table, const KnownPlanes& planes, int num_threads)
      : table_(&table), num_threads_(num_threads) {
    number();
    place(planes);
    connect();
  }

  void relax(const std::int8_t* sides, int iterations, float* distances_m) {
    // Errors whose eigenvalues are in [least, 1] shrink to 1 / cosh(4). No eigenvalue is above 1: see `stiffness`.
    const float least = 4 / std::max(4.1F, static_cast<float>(iterations) * static_cast<float>(iterations));
    const float middle = (1 + least) / 2, half = (1 - least) / 2;
    const std::size_t size = kPlateVertices * num_blocks_;
    LargeVector<float> before_m(size + kPlateVertices, 0.0F), after_m(size + kPlateVertices, 0.0F);
    LargeVector<float> steps_m(size, 0.0F), pulls_m(size, 0.0F);
    LargeVector<std::int8_t> side(size, 0);
    for (std::size_t row = 0; row < vertices_.size(); ++row) {
      const auto v = static_cast<std::size_t>(vertices_[row]);
      before_m[v] = distances_m[row];
      if (compliance_[v] > 0) side[v] = sides[row];
    }
    const PlateKernels kernels = RADARSDF_KERNEL(plate_kernels)();
    const PlatePlaces places{corners_.data(), first_.data(), shares_.data(), targets_m_.data()};
    PlateSweep sweep{};
    sweep.neighbours = neighbours_.data();
    sweep.is_bent = is_bent_.data();
    sweep.compliance = compliance_.data();
    sweep.sides = side.data();
    sweep.steps_m = steps_m.data();
    sweep.pulls_m = pulls_m.data();
    sweep.least_m = static_cast<float>(kClear * table_->leaf_size_m());
    std::size_t num_regions = 0;
    for (const std::vector<Range>& apart : regions_) num_regions += apart.size();
    const auto regions_of_thread =
        1 + kCells * static_cast<std::int64_t>(num_regions) / static_cast<std::int64_t>(first_.size());
    float rho = half / middle;
    for (int k = 0; k < iterations; ++k) {
      const float next = 1 / (2 * middle / half - rho);
      sweep.keep = k == 0 ? 0 : next * rho;
      sweep.gain = k == 0 ? 1 / middle : 2 * next / half;
      if (k > 0) rho = next;
      sweep.before_m = before_m.data();
      sweep.after_m = after_m.data();
      for (const std::vector<Range>& apart : regions_) {
        const auto count = static_cast<std::int64_t>(apart.size());
        parallel_blocks(count, regions_of_thread, num_threads_, [&](std::int64_t begin, std::int64_t end) {
          for (std::int64_t i = begin; i < end; ++i) {
            const Range& cells = apart[static_cast<std::size_t>(i)];
            kernels.pull(places, before_m.data(), pulls_m.data(), cells.first, cells.second);
          }
        });
      }
      parallel_blocks(static_cast<std::int64_t>(num_blocks_), kBlocks, num_threads_,
                      [&](std::int64_t begin, std::int64_t end) { kernels.sweep(sweep, begin, end); });
      std::swap(before_m, after_m);
    }
    for (std::size_t row = 0; row < vertices_.size(); ++row)
      distances_m[row] = before_m[static_cast<std::size_t>(vertices_[row])];
  }

 private:
  using Range = std::pair<std::int64_t, std::int64_t>;

  const std::int32_t* rows_of(std::size_t cell) const { return table_->cells()[cell].rows; }

  // Rows are numbered in Morton order, so those of a block follow each other.
  void number() {
    const std::vector<std::uint64_t> keys = leaf_vertex_keys(*table_);
    FlatMap numbers;
    std::vector<std::uint64_t> blocks;
    vertices_.reserve(keys.size());
    for (const std::uint64_t key : keys) {
      const std::uint64_t block = CellBlocks::block_key(key);
      if (blocks.empty() || blocks.back() != block) {
        numbers.insert(block, static_cast<std::int32_t>(blocks.size()));
        blocks.push_back(block);
      }
      vertices_.push_back(static_cast<std::int32_t>(kPlateVertices * (blocks.size() - 1) + kPosition[key & 63]));
    }
    num_blocks_ = blocks.size();
    if (kPlateVertices * (num_blocks_ + 1) > (std::size_t{1} << 31)) throw std::invalid_argument("too many vertices");
    neighbours_.reserve(6 * num_blocks_);
    for (const std::uint64_t block : blocks) {
      for (int axis = 0; axis < 3; ++axis) {
        for (const int step : {-1, 1}) {
          const std::int32_t found = numbers.find(morton_neighbour(block, axis, step));
          neighbours_.push_back(found >= 0 ? found : static_cast<std::int32_t>(num_blocks_));
        }
      }
    }
  }

  // The places in the order of their cells, in each in the order of the planes.
  void place(const KnownPlanes& planes) {
    const std::int64_t count = kPlaces * planes.count;
    const double size_m = table_->leaf_size_m();
    UninitialisedVector<float> points(static_cast<std::size_t>(3 * count));
    for (std::int64_t i = 0; i < count; ++i) {
      const float *point = planes.points + 3 * (i / kPlaces), *normal = planes.normals + 3 * (i / kPlaces);
      const auto before_m = static_cast<float>(static_cast<double>(i % kPlaces - 1) * size_m);
      for (int axis = 0; axis < 3; ++axis)
        points[static_cast<std::size_t>(3 * i + axis)] = point[axis] + before_m * normal[axis];
    }
    UninitialisedVector<std::uint64_t> keys(static_cast<std::size_t>(count));
    cell_keys(points.data(), count, size_m, keys.data(), num_threads_);
    const CellBlocks leaves(table_->leaf_keys().data(), static_cast<std::int64_t>(table_->leaf_keys().size()));
    UninitialisedVector<std::int32_t> cells(static_cast<std::size_t>(count));
    leaves.rows(keys.data(), count, cells.data(), num_threads_);
    drop_beyond_thin_walls(planes, cells);
    std::vector<std::int32_t> used = stable_order(keys.data(), count);
    used.erase(std::remove_if(used.begin(), used.end(),
                              [&](std::int32_t i) { return cells[static_cast<std::size_t>(i)] < 0; }),
               used.end());
    for (std::size_t k = 0; k < used.size(); ++k) {
      const auto i = static_cast<std::size_t>(used[k]);
      if (k == 0 || cells[i] != cells[static_cast<std::size_t>(used[k - 1])]) begin_cell(keys[i], cells[i], k);
    }
    first_.push_back(static_cast<std::int64_t>(used.size()));
    shares_.resize(8 * used.size());
    targets_m_.resize(used.size());
    const double scale = kBend * kBend * size_m * size_m / kPlaces;
    parallel_blocks(
        static_cast<std::int64_t>(used.size()), kPlacesOfThread, num_threads_,
        [&](std::int64_t begin, std::int64_t end) {
          for (auto k = static_cast<std::size_t>(begin); k < static_cast<std::size_t>(end); ++k) {
            const auto i = static_cast<std::size_t>(used[k]);
            const auto root =
                static_cast<float>(std::sqrt(scale * static_cast<double>(planes.information[i / kPlaces])));
            float upper[3];
            for (int axis = 0; axis < 3; ++axis) {
              const auto cell = static_cast<std::int32_t>(morton_coordinate(keys[i], axis)) - kAxisBias;
              const double fraction = points[3 * i + static_cast<std::size_t>(axis)] / size_m - cell;
              upper[axis] = static_cast<float>(std::clamp(fraction, 0.0, 1.0));
            }
            for (std::size_t c = 0; c < 8; ++c) {  // bit `axis` of a corner: whether it is the upper one
              float share = root;
              for (int axis = 0; axis < 3; ++axis) share *= (c >> axis & 1) != 0 ? upper[axis] : 1 - upper[axis];
              shares_[8 * k + c] = share;
            }
            targets_m_[k] =
                root * static_cast<float>(static_cast<double>(static_cast<std::int64_t>(i % kPlaces) - 1) * size_m);
          }
        });
  }

  // Cells come by regions of 16 x 16 x 16. Regions whose coordinates have the same parities share no vertex, so threads
  // add the pulls of several at once. A vertex gets its pulls in the same order with any number of threads, and where
  // only a part of the cells is given.
  void begin_cell(std::uint64_t key, std::int32_t cell, std::size_t first_place) {
    const std::uint64_t region = CellBlocks::region_key(key);
    const auto number = static_cast<std::int64_t>(first_.size());
    std::vector<Range>& apart = regions_[region & 7];
    if (first_.empty() || region != last_region_) apart.emplace_back(number, number);
    last_region_ = region;
    ++apart.back().second;
    first_.push_back(static_cast<std::int64_t>(first_place));
    for (int c = 0; c < 8; ++c)
      corners_.push_back(vertices_[static_cast<std::size_t>(rows_of(static_cast<std::size_t>(cell))[c])]);
  }

  // cells: of the places, -1 for those that do not count.
  void drop_beyond_thin_walls(const KnownPlanes& planes, UninitialisedVector<std::int32_t>& cells) const {
    std::vector<std::int64_t> plane_of(table_->leaf_keys().size(), -1);
    for (std::int64_t i = 0; i < planes.count; ++i) {
      const std::int32_t own = cells[static_cast<std::size_t>(kPlaces * i + 1)];
      if (own >= 0) plane_of[static_cast<std::size_t>(own)] = i;
    }
    for (std::int64_t i = 0; i < planes.count; ++i) {
      std::int32_t& behind = cells[static_cast<std::size_t>(kPlaces * i)];
      const std::int64_t other = behind >= 0 ? plane_of[static_cast<std::size_t>(behind)] : -1;
      if (other < 0) continue;
      const float *normal = planes.normals + 3 * i, *opposite = planes.normals + 3 * other;
      if (normal[0] * opposite[0] + normal[1] * opposite[1] + normal[2] * opposite[2] < 0) behind = -1;
    }
  }

  // Neighbours are vertices of the same cell. A distance is bent where there are some on both sides.
  void connect() {
    const std::size_t size = kPlateVertices * num_blocks_;
    LargeVector<std::uint8_t> edges(size + kPlateVertices, 0);  // bit `axis`: one before, bit `axis` + 3: one after
    for (std::size_t cell = 0; cell < table_->leaf_keys().size(); ++cell) {
      for (unsigned c = 0; c < 8; ++c) {  // upper corners have neighbours before them
        const auto v = static_cast<std::size_t>(vertices_[static_cast<std::size_t>(rows_of(cell)[c])]);
        edges[v] = static_cast<std::uint8_t>(edges[v] | c | (7U & ~c) << 3);
      }
    }
    LargeVector<std::uint8_t>& is_bent = edges;  // bit `axis`
    for (std::uint8_t& of_vertex : is_bent) of_vertex = static_cast<std::uint8_t>(of_vertex & of_vertex >> 3);
    LargeVector<float> stiffness(size, 0.0F);
    for (std::size_t i = 0; i + 1 < first_.size(); ++i) {
      for (std::int64_t k = first_[i]; k < first_[i + 1]; ++k) {
        const float* shares = shares_.data() + 8 * k;
        float root = 0;
        for (int c = 0; c < 8; ++c) root += shares[c];
        for (std::size_t c = 0; c < 8; ++c)
          stiffness[static_cast<std::size_t>(corners_[8 * i + c])] += root * shares[c];
      }
    }
    is_bent_.assign(kPlateBends * num_blocks_, 0);
    compliance_.resize(size);
    parallel_blocks(static_cast<std::int64_t>(num_blocks_), kBlocks, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto b = static_cast<std::size_t>(begin); b < static_cast<std::size_t>(end); ++b)
                        connect_block(b, is_bent.data(), stiffness.data() + kPlateVertices * b);
                    });
  }

  // The matrix is at most a diagonal of `stiffness`: (sum of a x)^2 <= (sum of |a|) (sum of |a| x^2), row by row.
  void connect_block(std::size_t block, const std::uint8_t* is_bent, float* stiffness) {
    std::uint8_t* of_lines = is_bent_.data() + kPlateBends * block;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const auto bent = [&](std::size_t of_block, unsigned position) {
        return static_cast<std::uint8_t>(is_bent[kPlateVertices * of_block + position] >> axis & 1U);
      };
      const auto before = static_cast<std::size_t>(neighbours_[6 * block + 2 * axis]);
      const auto after = static_cast<std::size_t>(neighbours_[6 * block + 2 * axis + 1]);
      for (unsigned i = 0; i < 16; ++i) {
        // A line along the axis: its four positions, and one of each neighbour.
        const unsigned stride = 1U << (2 * axis), first = axis == 0 ? 4 * i : axis == 1 ? i % 4 + 16 * (i / 4) : i;
        std::uint8_t line[6] = {bent(before, first + 3 * stride)};
        for (unsigned k = 0; k < 4; ++k) line[k + 1] = bent(block, first + k * stride);
        line[5] = bent(after, first);
        for (unsigned k = 0; k < 4; ++k)
          stiffness[first + k * stride] += static_cast<float>(4 * line[k] + 8 * line[k + 1] + 4 * line[k + 2]);
        if (axis == 0) {
          std::copy_n(line, 6, of_lines + 8 * i);
        } else {
          for (std::size_t k = 0; k < 6; ++k)
            of_lines[kBendsAlongX + (axis - 1) * kBendsAlongYZ + 16 * k + i] = line[k];
        }
      }
    }
    float* compliance = compliance_.data() + kPlateVertices * block;
    for (std::size_t i = 0; i < kPlateVertices; ++i) compliance[i] = stiffness[i] > 0 ? 1 / stiffness[i] : 0;
  }

  const VertexTable* table_;
  int num_threads_;
  LargeVector<std::int32_t> vertices_;  // position of each row in the blocks
  std::size_t num_blocks_ = 0;
  std::vector<std::int32_t> neighbours_;
  LargeVector<std::uint8_t> is_bent_;
  UninitialisedVector<float> compliance_;
  LargeVector<std::int32_t> corners_;  // of the cells with places
  std::vector<std::int64_t> first_;
  UninitialisedVector<float> shares_, targets_m_;
  std::array<std::vector<Range>, 8> regions_;  // of cells, by the parities of the coordinates
  std::uint64_t last_region_ = 0;
};

}  // namespace

void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  Plates(table, planes, num_threads).relax(sides, iterations, distances_m);
}

}  // namespace radarsdf
