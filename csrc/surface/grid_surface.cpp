// An edge of a voxel is known by the leaf cell's vertex at or below its lower end, and a bit of a mask there. A vertex
// of the mesh is numbered by the bits set before its own, so that cells which share it agree without a search.
#include "surface/grid_surface.hpp"

#include <algorithm>
#include <atomic>
#include <stdexcept>

#include "lattice/morton.hpp"
#include "surface/marching_cubes_common.hpp"
#include "surface/marching_cubes_table.hpp"
#include "util/bits.hpp"
#include "util/integers.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int64_t kCells = 1 << 11;  // per task, whatever the number of threads: faces are in the order of the tasks

// Linear interpolation, exact at both ends, so that cells agree on common faces.
inline float between(float before, float after, float share) { return (1 - share) * before + share * after; }

// Up to 3 x 3 x 3 voxels of a leaf cell, with their corners in a word: bit 16 x + 4 y + z.
constexpr int kSide = 4;
constexpr int kStep[3] = {16, 4, 1};

// The edges of a voxel, from its lower corner.
struct EdgeStep {
  int axis, step;
};
constexpr std::array<EdgeStep, 12> edge_steps() {
  std::array<EdgeStep, 12> steps{};
  for (int e = 0; e < 12; ++e) {
    const CellEdge edge = cell_edge(e);
    int step = 0;
    for (int axis = 0; axis < 3; ++axis) step += (edge.corner & axis_bit(axis)) != 0 ? kStep[axis] : 0;
    steps[e] = {edge.axis, step};
  }
  return steps;
}
constexpr std::array<EdgeStep, 12> kEdgeSteps = edge_steps();

struct Brick {
  int first[3] = {};  // voxel of the leaf cell
  int sides[3] = {};  // corners
  uint64_t voxels = 0;
  float shares[3][kSide] = {};  // positions of the corners in the leaf cell, 0 to 1
  // For each corner, the corner of the leaf cell at or below, x fastest; three bits there from this one on are its
  // edges.
  std::uint8_t corners[kSide * kSide * kSide] = {};
  int32_t bits[kSide * kSide * kSide] = {};
};

std::vector<Brick> bricks_of_cell(int parts) {
  std::vector<Brick> bricks;
  constexpr int kVoxels = kSide - 1;
  const int along = (parts + kVoxels - 1) / kVoxels;
  for (int b = 0; b < along * along * along; ++b) {
    Brick& brick = bricks.emplace_back();
    const int place[3] = {b / (along * along), b / along % along, b % along};
    for (int axis = 0; axis < 3; ++axis) {
      brick.first[axis] = kVoxels * place[axis];
      brick.sides[axis] = std::min(kSide, parts - brick.first[axis] + 1);
      for (int k = 0; k < kSide; ++k)
        brick.shares[axis][k] = static_cast<float>(std::min(brick.first[axis] + k, parts)) / static_cast<float>(parts);
    }
    for (int at = 0; at < kSide * kSide * kSide; ++at) {
      int corner = 0, bit = 0;
      bool is_voxel = true;
      for (int axis = 0; axis < 3; ++axis) {
        const int local = at / kStep[axis] % kSide, k = brick.first[axis] + local;
        is_voxel = is_voxel && local < kVoxels && k < parts;
        corner |= (k >= parts ? 1 : 0) << axis;
        bit = bit * parts + k % parts;
      }
      brick.corners[at] = static_cast<std::uint8_t>(corner);
      brick.bits[at] = 3 * bit;
      if (is_voxel) brick.voxels |= uint64_t{1} << at;
    }
  }
  return bricks;
}

// A brick of one leaf cell.
struct Samples {
  const Brick* brick;
  const int32_t* rows;  // of the leaf cell's corners
  int32_t lower[3];     // lattice coordinates of the first voxel
  uint64_t voxels;      // voxels with surface, of those to use
  uint64_t cut[3];      // edges of these voxels, by axis
  uint64_t positive;
  float distances_m[kSide * kSide * kSide];

  // values: at the corners of the leaf cell. used: voxels.
  void interpolate(const float* values, uint64_t used) {
    positive = 0;
    for (int x = 0; x < brick->sides[0]; ++x) {
      float along_x[4], along_y[2], along_z[kSide];
      for (int c = 0; c < 4; ++c) along_x[c] = between(values[2 * c], values[2 * c + 1], brick->shares[0][x]);
      for (int y = 0; y < brick->sides[1]; ++y) {
        for (int c = 0; c < 2; ++c) along_y[c] = between(along_x[2 * c], along_x[2 * c + 1], brick->shares[1][y]);
        for (int z = 0; z < kSide; ++z) along_z[z] = between(along_y[0], along_y[1], brick->shares[2][z]);
        unsigned signs = 0;
        for (int z = 0; z < kSide; ++z) signs |= unsigned{along_z[z] > 0} << z;
        positive |= uint64_t{signs} << (kStep[0] * x + kStep[1] * y);
        std::copy_n(along_z, kSide, distances_m + kStep[0] * x + kStep[1] * y);
      }
    }
    uint64_t any = positive, all = positive;
    for (const int step : kStep) {
      any |= any >> step;
      all &= all >> step;
    }
    voxels = used & any & ~all;
    for (int axis = 0; axis < 3; ++axis) {
      cut[axis] = used;
      for (int other = 0; other < 3; ++other)
        if (other != axis) cut[axis] |= cut[axis] << kStep[other];
      cut[axis] &= positive ^ positive >> kStep[axis];
    }
  }

  const CellTriangles& triangles(int at) const {
    const auto signs = static_cast<unsigned>(positive >> at);
    return marching_cubes_table()[(signs & 3) | (signs >> 2 & 12) | (signs >> 12 & 48) | (signs >> 14 & 192)];
  }
};

class GridSurface {
 public:
  GridSurface(const VertexTable& table, const float* distances_m, const int32_t* cells, int64_t num_cells,
              const GridVoxels& voxels, int num_threads)
      : table_(&table),
        distances_m_(distances_m),
        cells_(cells),
        num_cells_(num_cells),
        voxels_(voxels),
        num_threads_(num_threads),
        bricks_(bricks_of_cell(voxels.parts)) {
    const auto parts = static_cast<size_t>(voxels.parts);
    num_words_ = (3 * parts * parts * parts + 63) / 64;
    number_vertices_of_cells();
  }

  Mesh extract() {
    std::vector<MeshCounts> offsets(num_chunks(num_cells_, kCells) + 1);
    parallel_chunks(num_cells_, kCells, num_threads_,
                    [&](int64_t task, int64_t begin, int64_t end) { offsets[task + 1].faces = mark(begin, end); });
    int64_t& num_vertices = offsets.back().vertices;
    for (Word& word : words_) {
      word.first = static_cast<int32_t>(num_vertices);
      num_vertices += count_bits(word.cut);
    }
    Mesh mesh = sum_up(offsets, false);
    parallel_chunks(num_cells_, kCells, num_threads_, [&](int64_t task, int64_t begin, int64_t end) {
      write(begin, end, mesh.vertices.get(), mesh.faces.get() + 3 * offsets[task].faces);
    });
    return mesh;
  }

 private:
  struct Word {
    std::atomic<uint64_t> cut{0}, written{0};  // edges
    int32_t first = 0;                         // vertex of the mesh
  };

  const int32_t* rows_of(int64_t i) const { return table_->rows_of(cells_[i]); }

  void number_vertices_of_cells() {
    numbers_.assign(table_->num_rows(), 0);
    for (int64_t i = 0; i < num_cells_; ++i)
      for (int c = 0; c < 8; ++c) numbers_[rows_of(i)[c]] = 1;
    int32_t count = 0;
    for (int32_t& number : numbers_) {
      const int32_t used = number;
      number = count;
      count += used;
    }
    words_ = std::vector<Word>(static_cast<size_t>(count) * num_words_);
  }

  // Calls visit(samples) for the bricks with surface.
  template <typename Visit>
  void for_each_brick(int64_t begin, int64_t end, const Visit& visit) const {
    Samples samples;
    for (int64_t i = begin; i < end; ++i) {
      const uint64_t key = table_->leaf_keys()[cells_[i]];
      samples.rows = rows_of(i);
      float values[8];
      for (int c = 0; c < 8; ++c) values[c] = distances_m_[samples.rows[c]];
      for (const Brick& brick : bricks_) {
        samples.brick = &brick;
        for (int axis = 0; axis < 3; ++axis) {
          samples.lower[axis] = lattice_coordinate(key, axis) * voxels_.parts + brick.first[axis];
        }
        samples.interpolate(values, used(samples));
        if (samples.voxels != 0) visit(samples);
      }
    }
  }

  // The voxels of a brick within the limits.
  uint64_t used(const Samples& samples) const {
    uint64_t voxels = samples.brick->voxels;
    for (size_t axis = 0; axis < 3; ++axis) {
      const int32_t lower = samples.lower[axis];
      if (lower >= voxels_.lowest[axis] && lower + kSide <= voxels_.highest[axis]) continue;
      for (int at = 0; at < kSide * kSide * kSide; ++at) {
        const int32_t place = lower + at / kStep[axis] % kSide;
        if (place < voxels_.lowest[axis] || place > voxels_.highest[axis]) voxels &= ~(uint64_t{1} << at);
      }
    }
    return voxels;
  }

  // Calls visit(at, axis, word, bit) for each cut edge; at: its lower corner.
  template <typename Visit>
  void for_each_edge(const Samples& samples, const Visit& visit) {
    for (int axis = 0; axis < 3; ++axis) {
      for (uint64_t edges = samples.cut[axis]; edges != 0; edges &= edges - 1) {
        const int at = lowest_bit(edges), bit = samples.brick->bits[at] + axis;
        const auto vertex = static_cast<size_t>(samples.rows[samples.brick->corners[at]]);
        const size_t word = static_cast<size_t>(numbers_[vertex]) * num_words_ + static_cast<size_t>(bit) / 64;
        visit(at, axis, words_[word], uint64_t{1} << (bit % 64));
      }
    }
  }

  // Sets a bit; returns whether it was not set before, for one of the threads.
  static bool set(std::atomic<uint64_t>& word, uint64_t bit) {
    return (word.load(std::memory_order_relaxed) & bit) == 0 &&
           (word.fetch_or(bit, std::memory_order_relaxed) & bit) == 0;
  }

  // Marks the cut edges in some cells; returns their number of faces.
  int64_t mark(int64_t begin, int64_t end) {
    int64_t num_faces = 0;
    for_each_brick(begin, end, [&](const Samples& samples) {
      for (uint64_t voxels = samples.voxels; voxels != 0; voxels &= voxels - 1)
        num_faces += samples.triangles(lowest_bit(voxels)).num_triangles;
      for_each_edge(samples, [](int, int, Word& word, uint64_t bit) { set(word.cut, bit); });
    });
    return num_faces;
  }

  void write(int64_t begin, int64_t end, double* vertices, int32_t* faces) {
    const Lattice lattice{{voxels_.size_m, voxels_.size_m, voxels_.size_m}, {}};
    int32_t found[3][kSide * kSide * kSide];  // vertices of the edges
    for_each_brick(begin, end, [&](const Samples& samples) {
      for_each_edge(samples, [&](int at, int axis, Word& word, uint64_t bit) {
        const int32_t vertex = word.first + count_bits(word.cut.load(std::memory_order_relaxed) & (bit - 1));
        found[axis][at] = vertex;
        if (!set(word.written, bit)) return;
        Vec3 index;
        for (int k = 0; k < 3; ++k) index[k] = samples.lower[k] + at / kStep[k] % kSide;
        write_vertex(lattice, index, axis, double{samples.distances_m[at]},
                     double{samples.distances_m[at + kStep[axis]]}, 0, vertices + 3 * int64_t{vertex});
      });
      for (uint64_t voxels = samples.voxels; voxels != 0; voxels &= voxels - 1) {
        const int at = lowest_bit(voxels);
        const auto vertex_of = [&](int edge) { return found[kEdgeSteps[edge].axis][at + kEdgeSteps[edge].step]; };
        faces = write_triangles(samples.triangles(at), vertex_of, faces);
      }
    });
  }

  const VertexTable* table_;
  const float* distances_m_;
  const int32_t* cells_;
  int64_t num_cells_;
  GridVoxels voxels_;
  int num_threads_;
  std::vector<Brick> bricks_;
  size_t num_words_;              // for each vertex of a leaf cell
  std::vector<int32_t> numbers_;  // of the vertices of these cells, by row of the table
  std::vector<Word> words_;
};

void check_octree(const VertexTable& table) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
}

}  // namespace

std::vector<int32_t> cells_near_surface(const VertexTable& table, const float* distances_m, float margin_m,
                                        int num_threads) {
  check_octree(table);
  const auto count = static_cast<int64_t>(table.leaf_keys().size());
  std::vector<std::uint8_t> is_near(count);
  parallel_for(count, 1 << 14, num_threads, [&](int64_t i) {
    const int32_t* rows = table.rows_of(i);
    bool any_below = false, any_above = false, all_known = true;
    for (int c = 0; c < 8; ++c) {
      const float distance_m = distances_m[rows[c]];
      any_below |= distance_m <= margin_m;
      any_above |= distance_m >= -margin_m;
      all_known &= distance_m == distance_m;
    }
    is_near[i] = any_below && any_above && all_known;
  });
  std::vector<int32_t> rows;
  for (int64_t i = 0; i < count; ++i)
    if (is_near[i] != 0) rows.push_back(static_cast<int32_t>(i));
  return rows;
}

Mesh grid_surface(const VertexTable& table, const float* distances_m, const int32_t* cells, int64_t num_cells,
                  const GridVoxels& voxels, int num_threads) {
  check_octree(table);
  if (voxels.parts < 1) throw std::invalid_argument("parts must be at least 1");
  check_lattice({{voxels.size_m, voxels.size_m, voxels.size_m}, {}}, 0);
  const auto num_leaves = static_cast<int64_t>(table.leaf_keys().size());
  if (std::any_of(cells, cells + num_cells, [&](int32_t cell) { return cell < 0 || cell >= num_leaves; }))
    throw std::invalid_argument("a cell does not exist");
  return GridSurface(table, distances_m, cells, num_cells, voxels, num_threads).extract();
}

}  // namespace radarsdf
