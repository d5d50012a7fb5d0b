// Partition of row sums of the feature matrix into tasks: one for each level and group of corners, so that neither
// atomics nor private copies are needed, and each row is summed in the order of the points.
#pragma once

#include <cstdint>

#include "kernels/interpolation_kernels.hpp"
#include "lattice/vertex_table.hpp"

namespace radarsdf {

struct LevelTask {
  int level, group;
};

inline std::int64_t num_level_tasks(const VertexTable& table) {
  return std::int64_t{table.num_levels()} * num_vertex_groups(table.encoding());
}

// Coarse levels first: they have most points per row, and take longest.
inline LevelTask level_task(const VertexTable& table, std::int64_t task) {
  const int groups = num_vertex_groups(table.encoding()), number = static_cast<int>(task);
  return {table.num_levels() - 1 - number / groups, number % groups};
}

}  // namespace radarsdf
