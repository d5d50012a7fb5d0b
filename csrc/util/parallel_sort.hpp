// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

// Sorts in place: blocks on threads, then merged pairwise.
void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads);

}  // namespace radarsdf
