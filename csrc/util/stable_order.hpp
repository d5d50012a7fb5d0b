#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

// Stable argsort of at most 2^31 - 1 keys. A least-significant-digit radix sort: for many millions of keys it takes a
// quarter of the time of a comparison sort.
std::vector<std::int32_t> stable_order(const std::uint64_t* keys, std::int64_t count);

}  // namespace radarsdf
