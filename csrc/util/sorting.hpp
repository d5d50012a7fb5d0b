#pragma once

#include <cstdint>
#include <vector>

#include "util/large_array.hpp"

namespace radarsdf {

// Sorts in place: blocks in parallel, then pairwise merges.
void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads);

// Stable argsort of at most 2^31 - 1 keys. A least-significant-digit radix sort: for many millions of keys it takes a
// quarter of the time of a comparison sort.
std::vector<std::int32_t> stable_order(const std::uint64_t* keys, std::int64_t count);

// Sorts keys by their bits [begin_bit, end_bit), stably and serially: a radix sort, too.
void radix_sort(UninitialisedVector<std::uint64_t>& keys, int begin_bit, int end_bit);

}  // namespace radarsdf
