// Names of integer types for code that is full of them.
#pragma once

#include <cstddef>
#include <cstdint>

namespace radarsdf {
using std::int32_t, std::int64_t, std::size_t, std::uint32_t, std::uint64_t;
}  // namespace radarsdf
