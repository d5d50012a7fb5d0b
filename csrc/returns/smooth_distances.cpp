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
#include "util/thread_pool.hpp"

namespace radarsdf {
namespace {

// Layout. A vertex has the key of the cell whose lower corner it is; vertices and cells form blocks of 2 x 2 x 2.
//
//   rows of the table    0, 1, 2, ...                       in Morton order
//        | vertices_[row] = 8 * block + vertex
//        v
//   blocks of vertices   [0 .. 7] [0 .. 7] ... [0 .. 7]     one vector each; the last stands for missing blocks
//        | neighbours_[6 * block + 2 * axis + side]         adjacent blocks
//        | is_bent_[6 * block + axis], bit i                vertex i has neighbours on both sides along the axis
//        | is_bent_[6 * block + 3 + axis], bit i            its neighbour in the adjacent block has
//        ^
//        | corners_[8 * block of cells + c]                 blocks of vertices at corners c of the cells
//   blocks of cells      0, 1, 2, ...                       only those with constraints, by region
//        | first_[block of cells], ..., first_[block of cells + 1] - 1
//        v
//   layers_              [0 .. 7] [0 .. 7] ...              lane i: at most one constraint in cell i of the block
//
// A constraint is a point with known distance: three of each plane.
constexpr std::int64_t kBlocks = 1 << 11, kCells = 1 << 12, kConstraintsOfThread = 1 << 13,
                       kRegions = 1 << 4;  // minimum per thread
constexpr int kConstraints = 3;            // of a plane
constexpr double kBend = 2;      // leaf cells: second difference where the slope of a distance changes from -1 to 1
constexpr double kClear = 0.25;  // leaf cells: least distance of a vertex with known side

class PlateSmoother {
 public:
  PlateSmoother(const VertexTable& table, const KnownPlanes& planes, int num_threads)
      : table_(&table),
        num_threads_(num_threads),
        pool_(static_cast<int>(std::clamp<std::int64_t>(static_cast<std::int64_t>(table.leaf_keys().size()) / kCells, 1,
                                                        resolve_num_threads(num_threads)))) {
    number_vertices();
    sort_constraints(planes);
    connect_vertices();
  }

  void relax(const std::int8_t* sides, int iterations, float* distances_m) {
    // Chebyshev iteration: errors with eigenvalues in [least, 1] shrink to 1 / cosh(4). connect_block: none exceeds 1.
    const float least = 4 / std::max(4.1F, static_cast<float>(iterations) * static_cast<float>(iterations));
    const float middle = (1 + least) / 2, half = (1 - least) / 2;
    const std::size_t size = kPlateVertices * num_blocks_;
    LargeVector<float> before_m(size + kPlateVertices, 0.0F), after_m(size + kPlateVertices, 0.0F), pulls_m(size, 0.0F);
    LargeVector<std::int8_t> side(size, 0);
    for_each_row([&](std::int64_t row, std::int32_t v) {
      before_m[v] = distances_m[row];
      if (compliance_[v] > 0) side[v] = sides[row];
    });
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
      check_interrupt();
      pull(before_m.data(), static_cast<float>(table_->leaf_size_m()), pulls_m.data());
      run_blocks(num_blocks_, kBlocks,
                 [&](std::int64_t begin, std::int64_t end) { kernels_.sweep(sweep, begin, end); });
      std::swap(before_m, after_m);
    }
    for_each_row([&](std::int64_t row, std::int32_t v) { distances_m[row] = before_m[v]; });
  }

 private:
  using Range = std::pair<std::int64_t, std::int64_t>;

  // Rows are numbered in Morton order, so the rows of a block are consecutive, as are the eight blocks within one of
  // the table.
  void number_vertices() {
    const std::vector<VertexBlock>& of_table = table_->leaf_vertex_blocks();
    numbers_ = FlatMap(of_table.size());
    for (const VertexBlock& whole : of_table) {
      numbers_.insert(whole.key, static_cast<std::int32_t>(blocks_.size()));
      Occupancy blocks{0, static_cast<std::int32_t>(num_blocks_)};
      for (int i = 0; i < 8; ++i) blocks.mask |= std::uint64_t{(whole.parts.mask >> (8 * i) & 255) != 0} << i;
      num_blocks_ += count_bits(blocks.mask);
      if (kPlateVertices * (num_blocks_ + 1) > std::int64_t{1} << 31) throw std::invalid_argument("too many vertices");
      blocks_.push_back(blocks);
    }
    if (!of_table.empty()) vertices_.resize(of_table.back().parts.first + count_bits(of_table.back().parts.mask));
    neighbours_.resize(6 * num_blocks_);
    parallel_for(static_cast<std::int64_t>(of_table.size()), kBlocks / 8, num_threads_, [&](std::int64_t b) {
      const Occupancy& blocks = blocks_[b];
      std::int32_t* vertex = vertices_.data() + of_table[b].parts.first;
      for (std::uint64_t bits = of_table[b].parts.mask; bits != 0; bits &= bits - 1) {
        const auto part = static_cast<std::uint64_t>(lowest_bit(bits));
        *vertex++ = kPlateVertices * blocks.row(part >> 3) + static_cast<std::int32_t>(part & 7);
      }
      std::int32_t* neighbour = neighbours_.data() + 6 * std::int64_t{blocks.first};
      const Occupancy* next[6];
      for (int i = 0; i < 6; ++i) {
        const std::int32_t found = numbers_.find(morton_neighbour(of_table[b].key, i / 2, i % 2 != 0 ? 1 : -1));
        next[i] = found >= 0 ? &blocks_[found] : nullptr;
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
    });
  }

  template <typename Body>
  void for_each_row(const Body& body) const {
    parallel_for(static_cast<std::int64_t>(vertices_.size()), kPlateVertices * kBlocks, num_threads_,
                 [&](std::int64_t row) { body(row, vertices_[row]); });
  }

  // Constraints of a plane: one leaf cell behind it, on it, and one leaf cell before it.
  void constraint_point(const KnownPlanes& planes, std::int64_t constraint, float* point) const {
    const std::int64_t plane = constraint / kConstraints;
    const auto before_m =
        static_cast<float>(static_cast<double>(constraint % kConstraints - 1) * table_->leaf_size_m());
    for (int axis = 0; axis < 3; ++axis)
      point[axis] = planes.points[3 * plane + axis] + before_m * planes.normals[3 * plane + axis];
  }

  // Sorts the constraints by cell, stable in the order of the planes.
  void sort_constraints(const KnownPlanes& planes) {
    const std::int64_t count = kConstraints * planes.count;
    if (count > std::numeric_limits<std::int32_t>::max()) throw std::invalid_argument("too many planes");
    const double size_m = table_->leaf_size_m();
    UninitialisedVector<std::int32_t> cells(count);
    parallel_blocks(count, kConstraintsOfThread, num_threads_, [&](std::int64_t begin, std::int64_t end) {
      constexpr std::int64_t kAtOnce = 256;
      float points[3 * kAtOnce];
      std::uint64_t keys[kAtOnce];
      NearbyRows rows(table_->leaves());
      for (std::int64_t first = begin; first < end; first += kAtOnce) {
        const std::int64_t size = std::min(kAtOnce, end - first);
        for (std::int64_t i = 0; i < size; ++i) constraint_point(planes, first + i, points + 3 * i);
        cell_keys(points, size, size_m, keys, 1);
        for (std::int64_t i = 0; i < size; ++i) cells[first + i] = rows.row(keys[i]);
      }
    });
    drop_beyond_thin_walls(planes, cells);
    const std::vector<std::uint64_t>& keys = table_->leaf_keys();
    std::vector<std::int32_t> next(keys.size(), 0);  // counting sort by cell: counts, then insertion index
    for (const std::int32_t cell : cells)
      if (cell >= 0) ++next[cell];
    std::int32_t num_constraints = 0;
    for (std::int32_t& of_cell : next) num_constraints += std::exchange(of_cell, num_constraints);
    UninitialisedVector<std::int32_t> used(num_constraints);
    for (std::size_t i = 0; i < cells.size(); ++i) {
      if (cells[i] >= 0) used[next[cells[i]]++] = static_cast<std::int32_t>(i);
    }
    // By now, `next` is the end of the constraints of each cell.
    const auto first_of = [&](std::size_t cell) { return cell > 0 ? next[cell - 1] : 0; };
    std::vector<std::pair<std::size_t, std::size_t>> of_blocks;  // cells
    std::int32_t num_layers = 0;
    for (std::size_t cell = 0; cell < keys.size();) {
      const std::size_t first = cell;
      std::int32_t most = 0;
      for (; cell < keys.size() && keys[cell] >> 3 == keys[first] >> 3; ++cell)
        most = std::max(most, next[cell] - first_of(cell));
      if (most == 0) continue;
      add_to_region(keys[first], static_cast<std::int64_t>(of_blocks.size()));
      first_.push_back(num_layers);
      of_blocks.emplace_back(first, cell);
      num_layers += most;
    }
    first_.push_back(num_layers);
    layers_.resize(num_layers);
    corners_.resize(8 * of_blocks.size());
    const double scale = kBend * kBend * size_m * size_m / kConstraints;
    parallel_for(static_cast<std::int64_t>(of_blocks.size()), kCells / 4, num_threads_, [&](std::int64_t b) {
      std::fill(layers_.begin() + first_[b], layers_.begin() + first_[b + 1], ConstraintLayer{});
      for (std::size_t cell = of_blocks[b].first; cell < of_blocks[b].second; ++cell) {
        ConstraintLayer* layer = layers_.data() + first_[b];
        double lower[3];
        for (int axis = 0; axis < 3; ++axis) lower[axis] = lattice_coordinate(keys[cell], axis);
        for (std::int32_t k = first_of(cell); k < next[cell]; ++k)
          store_constraint(planes, used[k], lower, scale, keys[cell] & 7, *layer++);
      }
      find_corners(of_blocks[b], corners_.data() + 8 * b);
    });
  }

  // Stores constraint i in a lane of the layer. lower: corner of its cell, in cells.
  void store_constraint(const KnownPlanes& planes, std::int32_t i, const double* lower, double scale, std::size_t lane,
                        ConstraintLayer& layer) const {
    float point[3];
    std::uint32_t upper[3];
    constraint_point(planes, i, point);
    for (int axis = 0; axis < 3; ++axis) {
      const double share = std::clamp(point[axis] / table_->leaf_size_m() - lower[axis], 0.0, 1.0);
      upper[axis] = static_cast<std::uint32_t>(share * kPlateQuanta + 0.5);
    }
    layer.weights[lane] = static_cast<float>(scale * static_cast<double>(planes.information[i / kConstraints]));
    layer.x_and_y[lane] = upper[0] | upper[1] << 16;
    layer.z_and_leaf[lane] = upper[2] | static_cast<std::uint32_t>(i % kConstraints) << 16;
  }

  // Blocks of vertices that contain the corners of the cells of a block.
  void find_corners(const std::pair<std::size_t, std::size_t>& cells, std::int32_t* blocks) const {
    const auto block_of = [&](std::int32_t row) { return vertices_[row] / kPlateVertices; };
    std::fill_n(blocks, 8, -1);
    for (std::size_t cell = cells.first; cell < cells.second; ++cell) {
      const auto at = static_cast<unsigned>(table_->leaf_keys()[cell] & 7);
      const std::int32_t* rows = table_->rows_of(static_cast<std::int64_t>(cell));
      // Corners beyond the upper faces are in the next blocks.
      for (unsigned c = 0; c < 8; ++c) blocks[at & c] = block_of(rows[c]);
    }
    for (int c = 1; c < 8; ++c)
      if (blocks[c] < 0) blocks[c] = blocks[0];
  }

  // Blocks are grouped by regions of 16 x 16 x 16 cells. Regions with equal parities of all coordinates share no
  // vertex, so threads add their pulls in parallel. The order of pulls at a vertex depends neither on the number of
  // threads nor on the other cells present.
  void add_to_region(std::uint64_t key, std::int64_t number) {
    const std::uint64_t region = CellBlocks::region_key(key);
    std::vector<Range>& apart = regions_[region & 7];
    if (number == 0 || region != last_region_) apart.emplace_back(number, number);
    last_region_ = region;
    ++apart.back().second;
  }

  // Accumulates the pulls of all constraints in pulls_m.
  void pull(const float* distances_m, float leaf_m, float* pulls_m) {
    const PlateConstraints constraints{corners_.data(), first_.data(), layers_.data(), leaf_m};
    for (const std::vector<Range>& apart : regions_) {
      run_blocks(static_cast<std::int64_t>(apart.size()), kRegions, [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i)
          kernels_.pull(constraints, distances_m, pulls_m, apart[i].first, apart[i].second);
      });
    }
  }

  // As parallel_blocks, on threads that spin between jobs: nine per iteration, each shorter than it takes to wake one.
  template <typename Body>
  void run_blocks(std::int64_t size, std::int64_t min_block, const Body& body) {
    const std::int64_t blocks = std::clamp<std::int64_t>(size / min_block, 1, resolve_num_threads(num_threads_));
    pool_.run(blocks, [&](std::int64_t i) { body(size * i / blocks, size * (i + 1) / blocks); });
  }

  // cells: cell of each constraint; set to -1 for those to ignore.
  void drop_beyond_thin_walls(const KnownPlanes& planes, UninitialisedVector<std::int32_t>& cells) const {
    std::vector<std::int32_t> plane_of(table_->leaf_keys().size(), -1);
    for (std::int32_t i = 0; i < planes.count; ++i) {
      const std::int32_t own = cells[kConstraints * i + 1];
      if (own >= 0) plane_of[own] = i;
    }
    for (std::int32_t i = 0; i < planes.count; ++i) {
      std::int32_t& behind = cells[kConstraints * i];
      const std::int64_t other = behind >= 0 ? plane_of[behind] : -1;
      if (other < 0) continue;
      const float *normal = planes.normals + 3 * std::int64_t{i}, *opposite = planes.normals + 3 * other;
      if (normal[0] * opposite[0] + normal[1] * opposite[1] + normal[2] * opposite[2] < 0) behind = -1;
    }
  }

  // Neighbours share a cell. A distance is bent along an axis if its vertex has neighbours on both sides.
  void connect_vertices() {
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
    parallel_for(num_blocks_, kBlocks, num_threads_, [&](std::int64_t b) { connect_block(b); });
    // Where all distances are 1, a constraint of distance 0 pulls by the products of the shares.
    const LargeVector<float> ones(compliance_.size(), 1.0F);
    pull(ones.data(), 0, compliance_.data());
    parallel_for(num_blocks_, kBlocks, num_threads_, [&](std::int64_t b) {
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
        Edges& own = edges[numbers[c]];
        own.after[axis] |= lower[c];
        own.before[axis] |= shifted(lower[c], axis);
        const std::uint64_t beyond = carried(lower[c], axis);
        if (beyond != 0) edges[numbers[c | 1 << axis]].before[axis] |= beyond;
      }
    }
  }

  // A diagonal bounds the matrix, row by row: (sum of a x)^2 <= (sum of |a|) (sum of |a| x^2).
  void connect_block(std::int64_t block) {
    constexpr unsigned kLower[3] = {0x55, 0x33, 0x0f};  // masks of the lower vertices along each axis
    std::uint8_t* is_bent = is_bent_.data() + 6 * block;
    float* stiffness = compliance_.data() + kPlateVertices * block;
    std::fill_n(stiffness, kPlateVertices, 0.0F);
    for (int axis = 0; axis < 3; ++axis) {
      const auto next_to = [&](int side) {
        return unsigned{is_bent_[6 * std::int64_t{neighbours_[6 * block + 2 * axis + side]} + axis]};
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
  ThreadPool pool_;
  PlateKernels kernels_ = RADARSDF_KERNEL(plate_kernels)();
  UninitialisedVector<std::int32_t> vertices_;
  std::int64_t num_blocks_ = 0;
  FlatMap numbers_;                // index of the table's blocks by key
  std::vector<Occupancy> blocks_;  // by block of the table
  UninitialisedVector<std::int32_t> neighbours_;
  LargeVector<std::uint8_t> is_bent_;
  UninitialisedVector<float> compliance_;  // stiffness during setup
  std::vector<std::int32_t> first_;        // first layer of each block of cells
  UninitialisedVector<std::int32_t> corners_;
  UninitialisedVector<ConstraintLayer> layers_;
  std::array<std::vector<Range>, 8> regions_;  // ranges of these blocks, by parities of the region's coordinates
  std::uint64_t last_region_ = 0;
};

}  // namespace

void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  PlateSmoother(table, planes, num_threads).relax(sides, iterations, distances_m);
}

}  // namespace radarsdf
