// Free-space crossings: the leaf cells that rays crossed before their returns.
#pragma once

#include <cstdint>
#include <vector>

namespace radarsdf {

// Leaf cells are stored in blocks of 2^kFreeSpaceLevels along each edge.
constexpr int kFreeSpaceLevels = 3;
constexpr int kFreeSpaceWords = 8;  // of 64 bits, one for each leaf cell of a block
// Bit planes of a block: three for the number of scans with a ray through each leaf cell, saturated at 7, and one for
// the cells with returns.
constexpr int kCountPlanes = 3, kFreeSpacePlanes = kCountPlanes + 1;
constexpr int kFreeSpaceStride = kFreeSpacePlanes * kFreeSpaceWords;

struct FreeSpace {
  std::vector<std::uint64_t> keys;    // (B,) ascending block keys: those of leaf cells without their last 9 bits
  std::vector<std::uint64_t> planes;  // (B, planes, words); bit i of the 512 of a plane: leaf cell i in Morton order
};

// Computes the free-space crossings of rays. A ray crosses the cells from its sensor to `passed_m` along it, and has a
// return in the cell of its point. points, directions: (count, 3), ranges_m, passed_m: (count), local frame, m,
// passed_m at most ranges_m; scans: (count), ascending. lower, upper: (3), leaf cells; blocks entirely outside [lower,
// upper) are skipped. Saturated integers, independent of the number of threads and of the order of the rays of a scan.
// Throws std::invalid_argument for rays without keys.
FreeSpace find_free_space(const float* points, const float* directions, const float* ranges_m, const float* passed_m,
                          const std::int32_t* scans, std::int64_t count, double leaf_size_m, const std::int32_t* lower,
                          const std::int32_t* upper, int num_threads);

}  // namespace radarsdf
