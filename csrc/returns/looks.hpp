// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// How many scans looked at a place, and how many of them had a return there.
#pragma once

#include <cstdint>

namespace radarsdf {

// The cubes of 2^kLookLevels leaf cells along each edge whose looks are counted. Larger than the distance between two
// rays of a scan, so that a place between two rays counts as looked at.
constexpr int kLookLevels = 3;

// looks: (num_leaves), for each leaf cell the number of scans with a ray that goes through its cube or ends there. The
// rays of a scan begin at one sensor: of those that come together on the way there, one is followed on.
// leaf_keys: (num_leaves) Morton keys, ascending, each once; points, directions: (count, 3), ranges_m: (count), local
// frame, m; scans: (count), ascending, the scan of each ray. Throws std::invalid_argument for rays without keys.
void count_looks(const std::uint64_t* leaf_keys, std::int64_t num_leaves, double leaf_size_m, const float* points,
                 const float* directions, const float* ranges_m, const std::int32_t* scans, std::int64_t count,
                 std::uint32_t* looks, int num_threads);

// scans_of_cell: (num_cells), the number of different scans that have returns in each cell. cells: (count), the cell of
// each return; scans: (count), ascending, the scan of each.
void count_scans(const std::int32_t* cells, const std::int32_t* scans, std::int64_t count, std::int64_t num_cells,
                 std::uint32_t* scans_of_cell, int num_threads);

}  // namespace radarsdf
