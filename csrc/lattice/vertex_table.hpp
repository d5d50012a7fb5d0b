// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Look-up of the rows of the feature matrix from which a point is interpolated.
//
// Occupied cells of all levels form a forest: one exact hash look-up finds the cell of the coarsest level, child masks
// lead down from there. A cell stores the rows of its vertices, so that the 12 (tri-quadtree: four vertices on each of
// the planes xy, xz, yz) or 8 (octree) rows of a level cost one cache line instead of as many hash look-ups.
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

class VertexTable {
 public:
  // leaf_keys: unique ascending Morton keys of the occupied leaf cells (CellSet::sorted_keys). Rows are numbered by
  // level, plane and Morton order, and depend on the keys alone.
  VertexTable(std::vector<std::uint64_t> leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
              int num_threads);

  std::int64_t num_rows() const { return num_rows_; }
  std::int64_t num_cells() const { return static_cast<std::int64_t>(cells_.size()); }
  int num_levels() const { return num_levels_; }
  double leaf_size_m() const { return leaf_size_m_; }
  Encoding encoding() const { return encoding_; }
  const std::vector<std::uint64_t>& leaf_keys() const { return leaf_keys_; }
  const UninitialisedVector<Cell>& cells() const { return cells_; }
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
  UninitialisedVector<Cell> cells_;
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
