#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

// Sorts in place: blocks in parallel, then pairwise merges.
void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads);

}  // namespace radarsdf
