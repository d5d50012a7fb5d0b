// Look-up of the rows of the feature matrix from which a point is interpolated.
//
// Occupied cells of all levels form a forest: one exact hash look-up finds the cell of the coarsest level, child masks
// lead down from there. A cell of an octree stores the rows of its 8 vertices. A cell of a tri-quadtree stores the
// numbers of its faces, its projections on the planes xy, xz and yz, which store the rows of four vertices each: many
// cells share a face.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell.hpp"
#include "lattice/cell_blocks.hpp"
#include "util/large_array.hpp"

namespace radarsdf {

// Corners of a cell with features come in groups: one for each plane of a tri-quadtree, or one for an octree.
constexpr int num_vertex_groups(Encoding encoding) { return encoding == Encoding::kTriQuadtree ? 3 : 1; }
constexpr int corners_per_group(Encoding encoding) { return encoding == Encoding::kTriQuadtree ? 4 : 8; }

// Vertices of a block of 4 x 4 x 4, and their rows.
struct VertexBlock {
  std::uint64_t key;  // see CellBlocks::block_key
  Occupancy parts;
};

// Children of a cell.
struct Children {
  std::int32_t first;  // cell; the others follow in Morton order
  std::uint32_t mask;  // bit i: child i in Morton order is occupied
};

class VertexTable {
 public:
  // leaf_keys: unique ascending Morton keys of the occupied leaf cells (CellSet::sorted_keys). Rows are numbered by
  // level, plane and Morton order, and depend on the keys alone.
  VertexTable(std::vector<std::uint64_t> leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
              int num_threads);

  std::int64_t num_rows() const { return num_rows_; }
  std::int64_t num_cells() const { return static_cast<std::int64_t>(leaf_keys_.size() + children_.size()); }
  int num_levels() const { return num_levels_; }
  double leaf_size_m() const { return leaf_size_m_; }
  Encoding encoding() const { return encoding_; }
  const std::vector<std::uint64_t>& leaf_keys() const { return leaf_keys_; }
  // Faces of each cell, (cells, 3), empty for an octree: there, a cell is its only face.
  const UninitialisedVector<std::int32_t>& faces() const { return faces_; }
  // Rows of the feature matrix of the corners of each face: (faces, 4), for an octree (cells, 8).
  const UninitialisedVector<std::int32_t>& rows() const { return rows_; }
  // Rows of the corners of a cell of an octree.
  const std::int32_t* rows_of(std::int64_t cell) const { return rows_.data() + 8 * cell; }
  const CellBlocks& leaves() const { return leaves_; }
  // Vertices of the leaf cells of an octree, in Morton order: their rows are the first of the feature matrix.
  const std::vector<VertexBlock>& leaf_vertex_blocks() const { return leaf_vertex_blocks_; }

  // Locates the occupied cell of each point at every level, finest first, or -1: (count, num_levels). Points outside
  // the lattice and NaN are in no cell. Leaf cells are numbered in the order of their keys; coarser ones follow.
  template <typename T>
  void locate(const T* points, std::int64_t count, std::int32_t* cells) const;

 private:
  std::vector<std::uint64_t> leaf_keys_;
  double leaf_size_m_;
  int num_levels_;
  Encoding encoding_;
  UninitialisedVector<std::int32_t> faces_, rows_;
  LargeVector<Children> children_;         // of the cells coarser than leaf cells
  CellBlocks leaves_, roots_{nullptr, 0};  // roots_ only with more than one level
  std::vector<VertexBlock> leaf_vertex_blocks_;
  std::int64_t num_rows_ = 0;
};

// Vertices of the leaf cells of an octree: coordinates (rows, 3) by row of the feature matrix, and rows (leaf cells, 8)
// of each cell's corners in C order. Throws std::invalid_argument.
struct LeafVertices {
  std::vector<std::int32_t> coordinates, of_cells;
};
LeafVertices leaf_vertices(const VertexTable& table, int num_threads);

// Decodes keys to lattice coordinates (size, 3) of cells or vertices: cell i spans [i, i + 1) * leaf_size_m.
std::vector<std::int32_t> leaf_coordinates(const std::vector<std::uint64_t>& keys);

}  // namespace radarsdf
