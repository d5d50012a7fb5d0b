// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What one occupied cell knows. Plain data: the kernels include it once for each instruction set.
#pragma once

#include <cstdint>

namespace radarsdf {

constexpr int kFeatureDim = 8;  // floats a vertex: one AVX register, and the value of the paper
constexpr int kMaxLevels = 12;
constexpr int kMaxCorners = 12;

enum class Encoding { kTriQuadtree, kOctree };

struct alignas(64) Cell {
  std::int32_t rows[kMaxCorners];
  std::int32_t first_child;  // in the table's array of cells; the others of the eight follow in Morton order
  std::uint32_t child_mask;  // bit i: child i (of Morton order) is occupied
};
static_assert(sizeof(Cell) == 64, "a cell is one cache line");

}  // namespace radarsdf
