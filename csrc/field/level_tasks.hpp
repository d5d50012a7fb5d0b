// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// How sums by rows of the feature matrix are divided among threads: a level's rows of one group belong to one task, so
// there are no atomics and no private copies, and each row's sum is in the order of the points.
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

// Coarse levels first: they are hit most, and take longest.
inline LevelTask level_task(const VertexTable& table, std::int64_t task) {
  const int groups = num_vertex_groups(table.encoding()), number = static_cast<int>(task);
  return {table.num_levels() - 1 - number / groups, number % groups};
}

}  // namespace radarsdf
