#include "lattice/cell_blocks.hpp"

#include <limits>
#include <stdexcept>

#include "util/parallel.hpp"

namespace radarsdf {

CellBlocks::CellBlocks(const std::uint64_t* keys, std::int64_t count) : size_(count) {
  if (count > std::numeric_limits<std::int32_t>::max()) throw std::invalid_argument("more than 2^31 - 1 cells");
  for (std::int64_t i = 0; i < count; ++i) {
    if (i > 0 && keys[i] <= keys[i - 1]) throw std::invalid_argument("keys must be ascending, each once");
    if (i == 0 || block_key(keys[i]) != block_key(keys[i - 1])) {
      const auto block = static_cast<std::int32_t>(blocks_.size());
      if (i == 0 || region_key(keys[i]) != region_key(keys[i - 1])) {
        numbers_.insert(region_key(keys[i]), static_cast<std::int32_t>(regions_.size()));
        regions_.push_back({0, block});
      }
      regions_.back().mask |= std::uint64_t{1} << (block_key(keys[i]) & 63);
      blocks_.push_back({0, static_cast<std::int32_t>(i)});
    }
    blocks_.back().mask |= std::uint64_t{1} << (keys[i] & 63);
  }
}

void CellBlocks::rows(const std::uint64_t* keys, std::int64_t count, std::int32_t* rows, int num_threads) const {
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const Occupancy* found = region(region_key(keys[i]));
      const Occupancy* cells = found != nullptr ? block(*found, block_key(keys[i])) : nullptr;
      rows[i] = cells != nullptr ? cells->row(keys[i]) : -1;
    }
  });
}

}  // namespace radarsdf
