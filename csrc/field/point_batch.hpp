// Points and their cells, the input of the interpolation kernels.
#pragma once

#include <cstdint>

#include "kernels/interpolation_kernels.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

// Points (count, 3) and the cells that contain them; `directions` as in interpolation_kernels.hpp.
template <typename T>
struct PointBatch {
  const T* points;
  const T* directions;  // or null
  const std::int32_t* located;
  std::int64_t count;
};

template <typename T>
Interpolation<T> interpolation(const VertexTable& table, const PointBatch<T>& batch) {
  const T inverse_leaf_size = static_cast<T>(1.0 / table.leaf_size_m());
  const std::int32_t *faces = table.faces().data(), *rows = table.rows().data();
  return {faces, rows, batch.located, batch.points, batch.directions, table.num_levels(), inverse_leaf_size};
}

}  // namespace radarsdf
