// Unique cells of a list, their unique corners, and the corners of each cell.
#pragma once

#include <cstdint>
#include <memory>

namespace radarsdf {

struct SparseLattice {
  std::int64_t num_cells = 0;
  std::int64_t num_corners = 0;
  std::unique_ptr<std::int32_t[]> cells;    ///< (num_cells, 3) lower corners, each once, sorted by x, then y, then z
  std::unique_ptr<std::int32_t[]> corners;  ///< (num_corners, 3), each once, sorted likewise
  std::unique_ptr<std::int32_t[]> cell_corners;  ///< (num_cells, 8) rows of corners, in C order of the 2x2x2 block
};

// cells: (num_cells, 3) lattice coordinates of the lower corners, in any order, possibly repeated.
SparseLattice sparse_lattice(const std::int32_t* cells, std::int64_t num_cells, int num_threads);

}  // namespace radarsdf
