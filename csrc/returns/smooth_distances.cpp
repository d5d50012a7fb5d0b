// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/smooth_distances.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "kernels/plate_kernels.hpp"
#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/flat_map.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/instruction_set.hpp"
#include "util/large_array.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kBlocks = 1 << 11, kCells = 1 << 12, kPlacesOfThread = 1 << 13;  // minimum per thread
constexpr int kPlaces = 3;       // points of a plane with known distance
constexpr double kBend = 2;      // leaf cells: second difference where the slope of a distance changes from -1 to 1
constexpr double kClear = 0.25;  // leaf cells: least distance of a vertex with known side
class Plates {
 public:
  Plates(const VertexTable& table, const KnownPlanes& planes, int num_threads)
      : table_(&table), num_threads_(num_threads) {
    number();
    place(planes);
    connect();
  }

  void relax(const std::int8_t* sides, int iterations, float* distances_m) {
    // Chebyshev iteration: errors with eigenvalues in [least, 1] shrink to 1 / cosh(4). connect_block: none exceeds 1.
    const float least = 4 / std::max(4.1F, static_cast<float>(iterations) * static_cast<float>(iterations));
    const float middle = (1 + least) / 2, half = (1 - least) / 2;
    const std::size_t size = kPlateVertices * num_blocks_;
    LargeVector<float> before_m(size + kPlateVertices, 0.0F), after_m(size + kPlateVertices, 0.0F), pulls_m(size, 0.0F);
    LargeVector<std::int8_t> side(size, 0);
    of_rows([&](std::size_t row, std::size_t v) {
      before_m[v] = distances_m[row];
      if (compliance_[v] > 0) side[v] = sides[row];
    });
    const PlateKernels kernels = RADARSDF_KERNEL(plate_kernels)();
    const PlatePlaces places{corners_.data(), first_.data(), shares_.data(), targets_m_.data()};
    PlateSweep sweep{};
    sweep.neighbours = neighbours_.data();
    sweep.is_bent = is_bent_.data();
    sweep.compliance = compliance_.data();
    sweep.sides = side.data();
    sweep.pulls_m = pulls_m.data();
    sweep.least_m = static_cast<float>(kClear * table_->leaf_size_m());
    float rho = half / middle;
    for (int k = 0; k < iterations; ++k) {
      const float next = 1 / (2 * middle / half - rho);
      sweep.keep = k == 0 ? 0 : next * rho;
      sweep.gain = k == 0 ? 1 / middle : 2 * next / half;
      if (k > 0) rho = next;
      sweep.before_m = before_m.data();
      sweep.after_m = after_m.data();
      of_cells([&](std::int64_t begin, std::int64_t end) {
        kernels.pull(places, before_m.data(), pulls_m.data(), begin, end);
      });
      parallel_blocks(static_cast<std::int64_t>(num_blocks_), kBlocks, num_threads_,
                      [&](std::int64_t begin, std::int64_t end) { kernels.sweep(sweep, begin, end); });
      std::swap(before_m, after_m);
    }
    of_rows([&](std::size_t row, std::size_t v) { distances_m[row] = before_m[v]; });
  }

 private:
  using Range = std::pair<std::int64_t, std::int64_t>;

  // Rows are numbered in Morton order, so the rows of a block are consecutive, as are the eight blocks within one of
  // the table.
  void number() {
    const std::vector<VertexBlock>& of_table = table_->leaf_vertex_blocks();
    numbers_ = FlatMap(of_table.size());
    for (const VertexBlock& whole : of_table) {
      numbers_.insert(whole.key, static_cast<std::int32_t>(blocks_.size()));
      Occupancy blocks{0, static_cast<std::int32_t>(num_blocks_)};
      for (int i = 0; i < 8; ++i) blocks.mask |= std::uint64_t{(whole.parts.mask >> (8 * i) & 255) != 0} << i;
      num_blocks_ += static_cast<std::size_t>(count_bits(blocks.mask));
      if (kPlateVertices * (num_blocks_ + 1) > (std::size_t{1} << 31)) throw std::invalid_argument("too many vertices");
      blocks_.push_back(blocks);
    }
    if (!of_table.empty())
      vertices_.resize(static_cast<std::size_t>(of_table.back().parts.first + count_bits(of_table.back().parts.mask)));
    neighbours_.resize(6 * num_blocks_);
    parallel_blocks(static_cast<std::int64_t>(of_table.size()), kBlocks / 8, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto b = static_cast<std::size_t>(begin); b < static_cast<std::size_t>(end); ++b) {
                        const Occupancy& blocks = blocks_[b];
                        std::int32_t* vertex = vertices_.data() + of_table[b].parts.first;
                        for (std::uint64_t bits = of_table[b].parts.mask; bits != 0; bits &= bits - 1) {
                          const auto part = static_cast<std::uint64_t>(lowest_bit(bits));
                          *vertex++ = kPlateVertices * blocks.row(part >> 3) + static_cast<std::int32_t>(part & 7);
                        }
                        std::int32_t* neighbour = neighbours_.data() + 6 * std::int64_t{blocks.first};
                        const Occupancy* next[6];
                        for (int i = 0; i < 6; ++i) {
                          const std::int32_t found =
                              numbers_.find(morton_neighbour(of_table[b].key, i / 2, i % 2 != 0 ? 1 : -1));
                          next[i] = found >= 0 ? &blocks_[static_cast<std::size_t>(found)] : nullptr;
                        }
                        for (std::uint64_t bits = blocks.mask; bits != 0; bits &= bits - 1) {
                          const auto part = static_cast<std::uint64_t>(lowest_bit(bits));
                          for (int i = 0; i < 6; ++i) {
                            const bool stays = (part >> (i / 2) & 1) != static_cast<std::uint64_t>(i % 2);
                            const Occupancy* in = stays ? &blocks : next[i];
                            const std::int32_t found = in != nullptr ? in->row(part ^ std::uint64_t{1} << (i / 2)) : -1;
                            *neighbour++ = found >= 0 ? found : static_cast<std::int32_t>(num_blocks_);
                          }
                        }
                      }
                    });
  }

  template <typename Body>
  void of_rows(const Body& body) const {
    parallel_blocks(static_cast<std::int64_t>(vertices_.size()), kPlateVertices * kBlocks, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto row = static_cast<std::size_t>(begin); row < static_cast<std::size_t>(end); ++row)
                        body(row, static_cast<std::size_t>(vertices_[row]));
                    });
  }

  template <typename Body>
  void of_blocks(const Body& body) const {
    parallel_blocks(static_cast<std::int64_t>(num_blocks_), kBlocks, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto b = static_cast<std::size_t>(begin); b < static_cast<std::size_t>(end); ++b) body(b);
                    });
  }

  // Points of a plane: one leaf cell behind it, on it, and one leaf cell before it.
  void place_of(const KnownPlanes& planes, std::int64_t place, float* point) const {
    const std::int64_t plane = place / kPlaces;
    const auto before_m = static_cast<float>(static_cast<double>(place % kPlaces - 1) * table_->leaf_size_m());
    for (int axis = 0; axis < 3; ++axis)
      point[axis] = planes.points[3 * plane + axis] + before_m * planes.normals[3 * plane + axis];
  }

  // Sorts the points by cell, stable in the order of the planes.
  void place(const KnownPlanes& planes) {
    const std::int64_t count = kPlaces * planes.count;
    if (count > std::numeric_limits<std::int32_t>::max()) throw std::invalid_argument("too many planes");
    const double size_m = table_->leaf_size_m();
    UninitialisedVector<std::int32_t> cells(static_cast<std::size_t>(count));
    parallel_blocks(count, kPlacesOfThread, num_threads_, [&](std::int64_t begin, std::int64_t end) {
      constexpr std::int64_t kAtOnce = 256;
      float points[3 * kAtOnce];
      std::uint64_t keys[kAtOnce];
      NearbyRows rows(table_->leaves());
      for (std::int64_t first = begin; first < end; first += kAtOnce) {
        const std::int64_t size = std::min(kAtOnce, end - first);
        for (std::int64_t i = 0; i < size; ++i) place_of(planes, first + i, points + 3 * i);
        cell_keys(points, size, size_m, keys, 1);
        for (std::int64_t i = 0; i < size; ++i) cells[static_cast<std::size_t>(first + i)] = rows.row(keys[i]);
      }
    });
    drop_beyond_thin_walls(planes, cells);
    const std::vector<std::uint64_t>& keys = table_->leaf_keys();
    std::vector<std::int32_t> next(keys.size(), 0);  // counting sort by cell: counts, then insertion index
    for (const std::int32_t cell : cells)
      if (cell >= 0) ++next[static_cast<std::size_t>(cell)];
    std::int32_t num_places = 0;
    for (std::size_t cell = 0; cell < keys.size(); ++cell) {
      if (next[cell] == 0) continue;
      begin_cell(keys[cell], static_cast<std::int32_t>(cell), num_places);
      num_places += std::exchange(next[cell], num_places);
    }
    first_.push_back(num_places);
    UninitialisedVector<std::int32_t> used(static_cast<std::size_t>(num_places));
    for (std::size_t i = 0; i < cells.size(); ++i) {
      if (cells[i] >= 0)
        used[static_cast<std::size_t>(next[static_cast<std::size_t>(cells[i])]++)] = static_cast<std::int32_t>(i);
    }
    shares_.resize(8 * used.size());
    targets_m_.resize(used.size());
    corners_.resize(8 * cells_.size());
    const double scale = kBend * kBend * size_m * size_m / kPlaces;
    parallel_blocks(static_cast<std::int64_t>(cells_.size()), kCells, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto cell = static_cast<std::size_t>(begin); cell < static_cast<std::size_t>(end); ++cell) {
                        const std::uint64_t key = keys[static_cast<std::size_t>(cells_[cell])];
                        double lower[3];
                        for (int axis = 0; axis < 3; ++axis)
                          lower[axis] = static_cast<std::int32_t>(morton_coordinate(key, axis)) - kAxisBias;
                        for (std::int32_t k = first_[cell]; k < first_[cell + 1]; ++k)
                          share(planes, used[static_cast<std::size_t>(k)], lower, scale, static_cast<std::size_t>(k));
                        const std::int32_t* rows = table_->cells()[static_cast<std::size_t>(cells_[cell])].rows;
                        for (std::size_t c = 0; c < 8; ++c)
                          corners_[8 * cell + c] = vertices_[static_cast<std::size_t>(rows[c])];
                      }
                    });
  }

  // lower: corner of the cell of point i, in cells. k: index of its shares.
  void share(const KnownPlanes& planes, std::int32_t i, const double* lower, double scale, std::size_t k) {
    const double size_m = table_->leaf_size_m();
    const auto root = static_cast<float>(std::sqrt(scale * static_cast<double>(planes.information[i / kPlaces])));
    float point[3], upper[3];
    place_of(planes, i, point);
    for (int axis = 0; axis < 3; ++axis)
      upper[axis] = static_cast<float>(std::clamp(point[axis] / size_m - lower[axis], 0.0, 1.0));
    for (std::size_t c = 0; c < 8; ++c) {  // bit `axis` of a corner: set if upper
      float product = root;
      for (int axis = 0; axis < 3; ++axis) product *= (c >> axis & 1) != 0 ? upper[axis] : 1 - upper[axis];
      shares_[8 * k + c] = product;
    }
    targets_m_[k] = root * static_cast<float>((i % kPlaces - 1) * size_m);
  }

  // Cells are grouped by regions of 16 x 16 x 16. Regions with equal parities of all coordinates share no vertex, so
  // threads add their pulls in parallel. The order of pulls at a vertex depends neither on the number of threads nor on
  // the other cells present.
  void begin_cell(std::uint64_t key, std::int32_t cell, std::int32_t first_place) {
    const std::uint64_t region = CellBlocks::region_key(key);
    const auto number = static_cast<std::int64_t>(cells_.size());
    std::vector<Range>& apart = regions_[region & 7];
    if (cells_.empty() || region != last_region_) apart.emplace_back(number, number);
    last_region_ = region;
    ++apart.back().second;
    first_.push_back(first_place);
    cells_.push_back(cell);
  }

  // Calls body(begin, end) for the cells of each region, in parallel for regions that share no vertex.
  template <typename Body>
  void of_cells(const Body& body) const {
    std::size_t num_regions = 0;
    for (const std::vector<Range>& apart : regions_) num_regions += apart.size();
    const auto regions_of_thread =
        1 + kCells * static_cast<std::int64_t>(num_regions) / static_cast<std::int64_t>(first_.size());
    for (const std::vector<Range>& apart : regions_) {
      const auto count = static_cast<std::int64_t>(apart.size());
      parallel_blocks(count, regions_of_thread, num_threads_, [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i) {
          const Range& cells = apart[static_cast<std::size_t>(i)];
          body(cells.first, cells.second);
        }
      });
    }
  }

  // cells: cell of each point; set to -1 for points to ignore.
  void drop_beyond_thin_walls(const KnownPlanes& planes, UninitialisedVector<std::int32_t>& cells) const {
    std::vector<std::int32_t> plane_of(table_->leaf_keys().size(), -1);
    for (std::int32_t i = 0; i < planes.count; ++i) {
      const std::int32_t own = cells[static_cast<std::size_t>(kPlaces * i + 1)];
      if (own >= 0) plane_of[static_cast<std::size_t>(own)] = i;
    }
    for (std::int32_t i = 0; i < planes.count; ++i) {
      std::int32_t& behind = cells[static_cast<std::size_t>(kPlaces * i)];
      const std::int64_t other = behind >= 0 ? plane_of[static_cast<std::size_t>(behind)] : -1;
      if (other < 0) continue;
      const float *normal = planes.normals + 3 * std::int64_t{i}, *opposite = planes.normals + 3 * other;
      if (normal[0] * opposite[0] + normal[1] * opposite[1] + normal[2] * opposite[2] < 0) behind = -1;
    }
  }

  // Neighbours share a cell. A distance is bent along an axis if its vertex has neighbours on both sides.
  void connect() {
    std::vector<Edges> edges(blocks_.size());
    const std::vector<std::uint64_t>& keys = table_->leaf_keys();
    for (std::size_t i = 0; i < keys.size();) {
      const std::uint64_t block = CellBlocks::block_key(keys[i]);
      std::uint64_t cells = 0;
      for (; i < keys.size() && CellBlocks::block_key(keys[i]) == block; ++i)
        cells |= std::uint64_t{1} << (keys[i] & 63);
      connect_cells(block, cells, edges);
    }
    is_bent_.resize(6 * (num_blocks_ + 1), 0);
    for (std::size_t b = 0; b < blocks_.size(); ++b) {
      std::uint8_t* is_bent = is_bent_.data() + 6 * std::int64_t{blocks_[b].first};
      for (std::uint64_t bits = blocks_[b].mask; bits != 0; bits &= bits - 1, is_bent += 6) {
        for (int axis = 0; axis < 3; ++axis)
          is_bent[axis] =
              static_cast<std::uint8_t>((edges[b].before[axis] & edges[b].after[axis]) >> (8 * lowest_bit(bits)));
      }
    }
    compliance_.resize(kPlateVertices * num_blocks_);
    of_blocks([&](std::size_t b) { connect_block(b); });
    of_cells([&](std::int64_t begin, std::int64_t end) {
      for (auto cell = static_cast<std::size_t>(begin); cell < static_cast<std::size_t>(end); ++cell) {
        const std::int32_t* corners = corners_.data() + 8 * cell;
        for (auto k = static_cast<std::size_t>(first_[cell]); k < static_cast<std::size_t>(first_[cell + 1]); ++k) {
          const float* shares = shares_.data() + 8 * k;
          float root = 0;
          for (int c = 0; c < 8; ++c) root += shares[c];
          for (int c = 0; c < 8; ++c) compliance_[static_cast<std::size_t>(corners[c])] += root * shares[c];
        }
      }
    });
    of_blocks([&](std::size_t b) {
      float* compliance = compliance_.data() + kPlateVertices * b;
      for (std::size_t i = 0; i < kPlateVertices; ++i) compliance[i] = compliance[i] > 0 ? 1 / compliance[i] : 0;
    });
  }

  // Bit i: vertex i of a block, in Morton order, has a neighbour along an axis.
  struct Edges {
    std::uint64_t before[3] = {}, after[3] = {};
  };

  // Connects the cells of a block by bit masks. Their vertices lie in it and in the next blocks, numbered like corners.
  void connect_cells(std::uint64_t block, std::uint64_t cells, std::vector<Edges>& edges) const {
    std::uint64_t keys[8] = {block};
    for (int axis = 0; axis < 3; ++axis)
      for (int c = 0; c < 1 << axis; ++c) keys[c + (1 << axis)] = morton_neighbour(keys[c], axis, 1);
    std::int32_t numbers[8];
    for (int c = 0; c < 8; ++c) numbers[c] = numbers_.find(keys[c]);
    for (int axis = 0; axis < 3; ++axis) {
      std::uint64_t lower[8] = {cells};  // lower corners of cells along the axis
      for (const int other : {(axis + 1) % 3, (axis + 2) % 3}) {
        for (int c = 0; c < 8; ++c) {
          if (lower[c] == 0 || (c >> other & 1) != 0) continue;
          lower[c | 1 << other] |= carried(lower[c], other);
          lower[c] |= shifted(lower[c], other);
        }
      }
      for (int c = 0; c < 8; ++c) {
        if (lower[c] == 0) continue;
        Edges& own = edges[static_cast<std::size_t>(numbers[c])];
        own.after[axis] |= lower[c];
        own.before[axis] |= shifted(lower[c], axis);
        const std::uint64_t beyond = carried(lower[c], axis);
        if (beyond != 0) edges[static_cast<std::size_t>(numbers[c | 1 << axis])].before[axis] |= beyond;
      }
    }
  }

  // A diagonal bounds the matrix, row by row: (sum of a x)^2 <= (sum of |a|) (sum of |a| x^2).
  void connect_block(std::size_t block) {
    constexpr unsigned kLower[3] = {0x55, 0x33, 0x0f};  // masks of the lower vertices along each axis
    std::uint8_t* is_bent = is_bent_.data() + 6 * block;
    float* stiffness = compliance_.data() + kPlateVertices * block;
    std::fill_n(stiffness, kPlateVertices, 0.0F);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const auto next_to = [&](std::size_t after) {
        const auto next = static_cast<std::size_t>(neighbours_[6 * block + 2 * axis + after]);
        return unsigned{is_bent_[6 * next + axis]};
      };
      const int step = 1 << axis;
      const unsigned own = is_bent[axis], lower = kLower[axis];
      const unsigned next = (next_to(0) >> step & lower) | (next_to(1) << step & ~lower & 255U);
      const unsigned across = (own >> step & lower) | (own << step & ~lower & 255U);
      is_bent[3 + axis] = static_cast<std::uint8_t>(next);
      for (int i = 0; i < kPlateVertices; ++i)
        stiffness[i] += static_cast<float>(8 * (own >> i & 1) + 4 * (next >> i & 1) + 4 * (across >> i & 1));
    }
  }

  const VertexTable* table_;
  int num_threads_;
  UninitialisedVector<std::int32_t> vertices_;  // position in the blocks of each row
  std::size_t num_blocks_ = 0;
  FlatMap numbers_;                // index of the table's blocks by key
  std::vector<Occupancy> blocks_;  // by block of the table
  UninitialisedVector<std::int32_t> neighbours_;
  LargeVector<std::uint8_t> is_bent_;
  UninitialisedVector<float> compliance_;  // stiffness during setup
  std::vector<std::int32_t> cells_;        // cells with points
  std::vector<std::int32_t> first_;        // first point of each such cell
  UninitialisedVector<std::int32_t> corners_;
  UninitialisedVector<float> shares_, targets_m_;
  std::array<std::vector<Range>, 8> regions_;  // ranges of cells, by parities of the region's coordinates
  std::uint64_t last_region_ = 0;
};

}  // namespace

void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  Plates(table, planes, num_threads).relax(sides, iterations, distances_m);
}

}  // namespace radarsdf
