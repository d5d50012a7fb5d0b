#include "returns/smooth_distances.hpp"

#include <algorithm>
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
#include "util/sorting.hpp"
#include "util/thread_pool.hpp"

namespace radarsdf {
namespace {

// Layout. A vertex has the key of the cell whose lower corner it is; vertices and cells form blocks of 2 x 2 x 2.
//
//   rows of the table    0, 1, 2, ...                       in Morton order
//        | vertices_[row] = 8 * block + vertex
//        v
//   blocks of vertices   [0 .. 7] [0 .. 7] ... [0 .. 7]     one vector each, by slab; the last: missing ones
//        | neighbours_[6 * block + 2 * axis + side]         adjacent blocks
//        | is_bent_[6 * block + axis], bit i                vertex i has neighbours on both sides along the axis
//        | is_bent_[6 * block + 3 + axis], bit i            its neighbour in the adjacent block has
//        ^
//        | corners_[8 * block of cells + c]                 blocks of vertices at corners c of the cells
//   blocks of cells      0, 1, 2, ...                       only those with constraints, by slab
//        | first_[block of cells], ..., first_[block of cells + 1] - 1
//        v
//   layers_              [0 .. 7] [0 .. 7] ...              lane i: at most one constraint in cell i of the block
//
// A slab has the blocks at one position along x. A constraint is a point with known distance: three of each plane.
constexpr std::int64_t kBlocks = 1 << 11, kCells = 1 << 12, kConstraintsOfThread = 1 << 13;  // minimum per thread
constexpr int kConstraints = 3;                                                              // of a plane
// Iterations at once, at least. Measured on 4.7 million vertices: 0.89 s (1), 0.80 (2 to 8), 0.85 (12), 0.90 (24).
constexpr int kFused = 8;
constexpr double kBend = 2;      // leaf cells: second difference where the slope of a distance changes from -1 to 1
constexpr float kClear = 0.25F;  // leaf cells: least distance of a vertex with known side

class PlateSmoother {
 public:
  PlateSmoother(const VertexTable& table, const KnownPlanes& planes, int num_threads)
      : table_(&table),
        leaf_m_(static_cast<float>(table.leaf_size_m())),
        num_threads_(resolve_num_threads(num_threads)),
        pool_(static_cast<int>(std::clamp<std::int64_t>(table.leaves().size() / kCells, 1, num_threads_))) {
    number_vertices();
    sort_constraints(planes);
    connect_vertices();
  }

  void relax(const std::int8_t* sides, int iterations, float* distances_m) {
    // Chebyshev iteration: errors with eigenvalues in [least, 1] shrink to 1 / cosh(4). connect_block: none exceeds 1.
    const float least = 4 / std::max(4.1F, static_cast<float>(iterations) * static_cast<float>(iterations));
    const float middle = (1 + least) / 2, half = (1 - least) / 2;
    const std::size_t size = kPlateVertices * num_blocks_;
    LargeVector<float> after_m(size + kPlateVertices, 0.0F), pulls_m(size, 0.0F);
    LargeVector<std::int8_t> side(size, 0);
    before_m_.assign(size + kPlateVertices, 0.0F);
    for_each_row([&](std::int64_t row, std::int32_t v) {
      before_m_[v] = distances_m[row];
      if (compliance_[v] > 0) side[v] = sides[row];
    });
    std::vector<PlateSweep> sweeps;
    float rho = half / middle;
    for (int k = 0; k < iterations; ++k) {
      const float next = 1 / (2 * middle / half - rho);
      sweeps.push_back({neighbours_.data(), is_bent_.data(), compliance_.data(), side.data(), before_m_.data(),
                        after_m.data(), pulls_m.data(), k == 0 ? 0 : next * rho, k == 0 ? 1 / middle : 2 * next / half,
                        kClear * leaf_m_});
      if (k > 0) rho = next;
      before_m_.swap(after_m);
    }
    // Several iterations pass over the slabs at once, each two slabs behind the one before, whose results it needs at
    // both neighbours. What they share stays in the cache.
    const std::int64_t num_slabs = std::size(slabs_) - 1, fused = std::max(kFused, num_threads_);
    for (std::int64_t start = 0; start < iterations; start += fused) {
      const std::int64_t count = std::min(fused, iterations - start);
      for (std::int64_t time = 0; time < num_slabs + 2 * (count - 1); ++time) {
        const std::int64_t first = std::max<std::int64_t>(0, (time - num_slabs + 2) / 2);
        check_interrupt();
        pool_.run(std::min(count, time / 2 + 1) - first, [&](std::int64_t i) {
          const Slab* slab = slabs_.data() + (time - 2 * (first + i));
          const PlateSweep& sweep = sweeps[start + first + i];
          pull(*slab, sweep.before_m, leaf_m_, sweep.pulls_m);
          kernels_.sweep(sweep, slab[0].vertices, slab[1].vertices);
        });
      }
    }
    for_each_row([&](std::int64_t row, std::int32_t v) { distances_m[row] = before_m_[v]; });
  }

 private:
  struct Slab {
    std::uint64_t x;               // of its blocks
    std::int64_t vertices, cells;  // first blocks; the others follow
  };

  void number_vertices() {
    const std::vector<VertexBlock>& of_table = table_->leaf_vertex_blocks();
    numbers_ = FlatMap(of_table.size());
    std::vector<std::uint64_t> x;
    for (const VertexBlock& whole : of_table) {
      numbers_.insert(whole.key, static_cast<std::int32_t>(x.size() / 2));
      for (std::uint64_t half = 0; half < 2; ++half) x.push_back(2 * morton_coordinate(whole.key, 0) + half);
    }
    blocks_.resize(x.size());
    for (const std::int32_t half : stable_order(x.data(), static_cast<std::int64_t>(x.size()))) {
      Occupancy& blocks = blocks_[half];
      blocks = {0, static_cast<std::int32_t>(num_blocks_)};
      for (int i = half % 2; i < 8; i += 2)
        blocks.mask |= std::uint64_t{(of_table[half / 2].parts.mask >> (8 * i) & 255) != 0} << i;
      if (blocks.mask == 0) continue;
      if (slabs_.empty() || slabs_.back().x != x[half]) slabs_.push_back({x[half], num_blocks_, 0});
      num_blocks_ += count_bits(blocks.mask);
      if (kPlateVertices * (num_blocks_ + 1) > std::int64_t{1} << 31) throw std::invalid_argument("too many vertices");
    }
    slabs_.push_back({kEmptyKey, num_blocks_, 0});
    if (!of_table.empty()) vertices_.resize(of_table.back().parts.first + count_bits(of_table.back().parts.mask));
    neighbours_.resize(6 * num_blocks_);
    parallel_for(static_cast<std::int64_t>(of_table.size()), kBlocks / 8, num_threads_, [&](std::int64_t b) {
      std::int32_t* vertex = vertices_.data() + of_table[b].parts.first;
      for (std::uint64_t bits = of_table[b].parts.mask; bits != 0; bits &= bits - 1) {
        const auto part = static_cast<std::uint64_t>(lowest_bit(bits));
        *vertex++ = kPlateVertices * block_row(b, part >> 3) + static_cast<std::int32_t>(part & 7);
      }
      std::int64_t next[6];
      for (int i = 0; i < 6; ++i)
        next[i] = numbers_.find(morton_neighbour(of_table[b].key, i / 2, i % 2 != 0 ? 1 : -1));
      for (std::uint64_t part = 0; part < 8; ++part) {
        const std::int32_t own = block_row(b, part);
        if (own < 0) continue;
        for (int i = 0; i < 6; ++i) {
          const bool stays = (part >> (i / 2) & 1) != static_cast<std::uint64_t>(i % 2);
          const std::int32_t found = block_row(stays ? b : next[i], part ^ std::uint64_t{1} << (i / 2));
          neighbours_[6 * std::int64_t{own} + i] = found >= 0 ? found : static_cast<std::int32_t>(num_blocks_);
        }
      }
    });
  }

  // A block in one of the table, which may be missing: then -1.
  std::int32_t block_row(std::int64_t of_table, std::uint64_t part) const {
    return of_table >= 0 ? blocks_[2 * of_table + static_cast<std::int64_t>(part & 1)].row(part) : -1;
  }

  template <typename Body>
  void for_each_row(const Body& body) const {
    parallel_for(static_cast<std::int64_t>(vertices_.size()), kPlateVertices * kBlocks, num_threads_,
                 [&](std::int64_t row) { body(row, vertices_[row]); });
  }

  // Constraints of a plane: one leaf cell behind it, on it, and one leaf cell before it.
  void constraint_point(const KnownPlanes& planes, std::int64_t constraint, float* point) const {
    const std::int64_t plane = constraint / kConstraints;
    const float before_m = static_cast<float>(constraint % kConstraints - 1) * leaf_m_;
    for (int axis = 0; axis < 3; ++axis)
      point[axis] = planes.points[3 * plane + axis] + before_m * planes.normals[3 * plane + axis];
  }

  struct CellRange {  // of a block
    std::size_t begin, end;
    std::int32_t num_layers;
  };

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
    std::vector<CellRange> of_blocks;
    std::vector<std::uint64_t> x;
    for (std::size_t cell = 0; cell < keys.size();) {
      const std::size_t first = cell;
      std::int32_t most = 0;
      for (; cell < keys.size() && keys[cell] >> 3 == keys[first] >> 3; ++cell)
        most = std::max(most, next[cell] - first_of(cell));
      if (most == 0) continue;
      of_blocks.push_back({first, cell, most});
      x.push_back(morton_coordinate(keys[first] >> 3, 0));
    }
    const std::vector<std::int32_t> order = stable_order(x.data(), static_cast<std::int64_t>(x.size()));
    const auto num_of_cells = static_cast<std::int64_t>(order.size());
    std::int32_t num_layers = 0;
    Slab* slab = slabs_.data();
    for (const std::int32_t block : order) {
      while (slab->x < x[block]) (++slab)->cells = static_cast<std::int64_t>(first_.size());
      first_.push_back(num_layers);
      num_layers += of_blocks[block].num_layers;
    }
    while (slab != &slabs_.back()) (++slab)->cells = num_of_cells;
    first_.push_back(num_layers);
    layers_.resize(num_layers);
    corners_.resize(8 * num_of_cells);
    const double scale = kBend * kBend * size_m * size_m / kConstraints;
    parallel_for(num_of_cells, kCells / 4, num_threads_, [&](std::int64_t b) {
      const CellRange& range = of_blocks[order[b]];
      std::fill(layers_.begin() + first_[b], layers_.begin() + first_[b + 1], ConstraintLayer{});
      for (std::size_t cell = range.begin; cell < range.end; ++cell) {
        ConstraintLayer* layer = layers_.data() + first_[b];
        double lower[3];
        for (int axis = 0; axis < 3; ++axis) lower[axis] = lattice_coordinate(keys[cell], axis);
        for (std::int32_t k = first_of(cell); k < next[cell]; ++k)
          store_constraint(planes, used[k], lower, scale, keys[cell] & 7, *layer++);
      }
      find_corners(range, corners_.data() + 8 * b);
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
  void find_corners(const CellRange& cells, std::int32_t* blocks) const {
    const auto block_of = [&](std::int32_t row) { return vertices_[row] / kPlateVertices; };
    std::fill_n(blocks, 8, block_of(table_->rows_of(static_cast<std::int64_t>(cells.begin))[0]));
    for (std::size_t cell = cells.begin; cell < cells.end; ++cell) {
      const auto at = static_cast<unsigned>(table_->leaf_keys()[cell] & 7);
      const std::int32_t* rows = table_->rows_of(static_cast<std::int64_t>(cell));
      // Corners beyond the upper faces are in the next blocks.
      for (unsigned c = 0; c < 8; ++c) blocks[at & c] = block_of(rows[c]);
    }
  }

  // Accumulates the pulls of the constraints of a slab in pulls_m, at its vertices and those of the next one.
  void pull(const Slab& slab, const float* distances_m, float leaf_m, float* pulls_m) const {
    const PlateConstraints constraints{corners_.data(), first_.data(), layers_.data(), leaf_m};
    kernels_.pull(constraints, distances_m, pulls_m, slab.cells, (&slab)[1].cells);
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
    std::vector<Edges> edges(blocks_.size() / 2);
    const std::vector<std::uint64_t>& keys = table_->leaf_keys();
    for (std::size_t i = 0; i < keys.size();) {
      const std::uint64_t block = CellBlocks::block_key(keys[i]);
      std::uint64_t cells = 0;
      for (; i < keys.size() && CellBlocks::block_key(keys[i]) == block; ++i)
        cells |= std::uint64_t{1} << (keys[i] & 63);
      connect_cells(block, cells, edges);
    }
    is_bent_.resize(6 * (num_blocks_ + 1), 0);
    for (std::size_t half = 0; half < blocks_.size(); ++half) {
      std::uint8_t* is_bent = is_bent_.data() + 6 * std::int64_t{blocks_[half].first};
      const Edges& own = edges[half / 2];
      for (std::uint64_t bits = blocks_[half].mask; bits != 0; bits &= bits - 1, is_bent += 6) {
        for (int axis = 0; axis < 3; ++axis)
          is_bent[axis] = static_cast<std::uint8_t>((own.before[axis] & own.after[axis]) >> (8 * lowest_bit(bits)));
      }
    }
    compliance_.resize(kPlateVertices * num_blocks_);
    parallel_for(num_blocks_, kBlocks, num_threads_, [&](std::int64_t b) { connect_block(b); });
    // Where all distances are 1, a constraint of distance 0 pulls by the products of the shares.
    before_m_.assign(compliance_.size() + kPlateVertices, 1.0F);
    for (std::uint64_t parity = 0; parity < 2; ++parity) {  // these slabs share no vertex
      pool_.run(static_cast<std::int64_t>(slabs_.size()) - 1, [&](std::int64_t i) {
        if (slabs_[i].x % 2 == parity) pull(slabs_[i], before_m_.data(), 0, compliance_.data());
      });
    }
    parallel_for(kPlateVertices * num_blocks_, kPlateVertices * kBlocks, num_threads_,
                 [&](std::int64_t v) { compliance_[v] = compliance_[v] > 0 ? 1 / compliance_[v] : 0; });
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
  float leaf_m_;
  int num_threads_;
  ThreadPool pool_;
  PlateKernels kernels_ = RADARSDF_KERNEL(plate_kernels)();
  UninitialisedVector<std::int32_t> vertices_;
  std::int64_t num_blocks_ = 0;
  FlatMap numbers_;                // index of the table's blocks by key
  std::vector<Occupancy> blocks_;  // by block of the table: those at even, and at odd positions along x
  std::vector<Slab> slabs_;        // ascending, and their end
  UninitialisedVector<std::int32_t> neighbours_;
  LargeVector<std::uint8_t> is_bent_;
  UninitialisedVector<float> compliance_;  // stiffness during setup
  LargeVector<float> before_m_;            // distances before an iteration
  std::vector<std::int32_t> first_;        // first layer of each block of cells
  UninitialisedVector<std::int32_t> corners_;
  UninitialisedVector<ConstraintLayer> layers_;
};

}  // namespace

void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  PlateSmoother(table, planes, num_threads).relax(sides, iterations, distances_m);
}

}  // namespace radarsdf
