// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// From a point to the rows of the feature matrix that it is interpolated from.
//
// Occupied cells of all levels form a forest: one exact hash look-up finds the cell of the coarsest level, child masks
// lead down from there. A cell carries the rows of its vertices, so that the 12 (tri-quadtree: four vertices on each
// of the planes xy, xz, yz) or 8 (octree) rows of a level cost one cache line instead of as many hash look-ups.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/cell.hpp"
#include "lattice/cell_blocks.hpp"
#include "util/large_array.hpp"

namespace radarsdf {

// The corners of a cell that carry features, in groups: one for each plane of a tri-quadtree, or one for all of space.
constexpr int num_vertex_groups(Encoding encoding) { return encoding == Encoding::kTriQuadtree ? 3 : 1; }
constexpr int corners_per_group(Encoding encoding) { return encoding == Encoding::kTriQuadtree ? 4 : 8; }

// The vertices of a block of 4 x 4 x 4, and their rows.
struct VertexBlock {
  std::uint64_t key;  // of CellBlocks::block_key
  Occupancy parts;
};

class VertexTable {
 public:
  // leaf_keys: Morton keys of the occupied leaf cells, ascending and unique (CellSet::sorted_keys). Rows are numbered
  // level by level, plane by plane, in Morton order: the same keys always give the same numbers.
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
  // Of an octree, the vertices of the leaf cells, in Morton order: their rows are the first of the feature matrix.
  const std::vector<VertexBlock>& leaf_vertex_blocks() const { return leaf_vertex_blocks_; }

  // The occupied cell of every level, finest first, that holds each point, or -1: (count, num_levels). Points outside
  // the lattice and NaN are in no cell. Leaf cells have the numbers of their keys, from 0; coarser ones follow.
  template <typename T>
  void locate(const T* points, std::int64_t count, std::int32_t* cells) const;

 private:
  std::vector<std::uint64_t> leaf_keys_;
  double leaf_size_m_;
  int num_levels_;
  Encoding encoding_;
  UninitialisedVector<Cell> cells_;
  CellBlocks leaves_, roots_{nullptr, 0};  // the second of a table with more than one level
  std::vector<VertexBlock> leaf_vertex_blocks_;
  std::int64_t num_rows_ = 0;
};

// Of a table of an octree, the vertices of the leaf cells: the coordinates (rows, 3) of those that the first rows of
// the feature matrix belong to, and the rows (leaf cells, 8) of each cell's, in C order. Throws std::invalid_argument.
struct LeafVertices {
  std::vector<std::int32_t> coordinates, of_cells;
};
LeafVertices leaf_vertices(const VertexTable& table, int num_threads);

// Lattice coordinates (size, 3) of cells or vertices: cell i spans [i, i + 1) * leaf_size_m.
std::vector<std::int32_t> leaf_coordinates(const std::vector<std::uint64_t>& keys);

}  // namespace radarsdf
