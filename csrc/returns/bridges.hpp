// Bridges over gaps: empty cells between two cells with returns, along the axes and diagonals of the lattice.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

constexpr int kMostBridgeCells = 14;

// Ascending Morton keys of leaf_keys (num_leaves) and of the bridges: at most max_cells cells between two of `ends`
// (num_ends) in one of 13 directions, if the sum of their support is below `least_dense`. leaf_keys and ends are
// unique, ascending, and within a million cells of the origin; max_cells is at most kMostBridgeCells. Independent of
// the number of threads.
std::vector<std::uint64_t> bridge_cells(const std::uint64_t* leaf_keys, std::int64_t num_leaves,
                                        const std::uint64_t* ends, const double* support, std::int64_t num_ends,
                                        int max_cells, double least_dense, int num_threads);

// medians: (count), for each cell the median of the positive values (count) in its block of 2^levels cells per edge, 0
// without one. keys: ascending Morton keys of the cells.
void block_medians(const std::uint64_t* keys, const double* values, std::int64_t count, int levels, double* medians,
                   int num_threads);

}  // namespace radarsdf
