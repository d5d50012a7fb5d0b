// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// The empty cells between two cells with returns, along the axes and the diagonals of the lattice.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

constexpr int kMostBridgeCells = 14;

// Morton keys, ascending, of leaf_keys, (num_leaves), and of the cells between two of `ends`, (num_ends), at most
// max_cells of them, in one of 13 directions, where the support of the two, added up, is below `least_dense`. leaf_keys
// and ends are ascending, each once, and lie within a million cells of the origin; max_cells is at most
// kMostBridgeCells. The same for any number of threads.
std::vector<std::uint64_t> bridge_cells(const std::uint64_t* leaf_keys, std::int64_t num_leaves,
                                        const std::uint64_t* ends, const double* support, std::int64_t num_ends,
                                        int max_cells, double least_dense, int num_threads);

}  // namespace radarsdf
