// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Data of an occupied cell. Plain data, since kernels include it once for each instruction set.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kFeatureDim = 8;  // floats per vertex: one AVX register, as in the paper
constexpr int kMaxLevels = 12;
constexpr int kMaxCorners = 12;

enum class Encoding { kTriQuadtree, kOctree };

struct alignas(64) Cell {
  std::int32_t rows[kMaxCorners];
  std::int32_t first_child;  // index in the table's cells; its siblings follow in Morton order
  std::uint32_t child_mask;  // bit i: child i in Morton order is occupied
};
static_assert(sizeof(Cell) == 64, "a cell is one cache line");

}  // namespace radarsdf
