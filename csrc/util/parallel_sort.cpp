#include "util/parallel_sort.hpp"

#include <algorithm>

#include "util/parallel.hpp"

namespace radarsdf {

void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads) {
  const auto size = static_cast<std::int64_t>(keys.size());
  std::int64_t blocks = 1;
  const std::int64_t threads = resolve_num_threads(num_threads);
  // Large inputs have more blocks than threads: an interrupt is handled only at the end of a block.
  while (size / blocks > (blocks * 2 <= threads ? 1 << 15 : 1 << 22)) blocks *= 2;
  const auto at = [&](std::int64_t i) { return keys.begin() + size * i / blocks; };
  parallel_tasks(blocks, num_threads, [&](std::int64_t i) { std::sort(at(i), at(i + 1)); });
  for (std::int64_t width = 1; width < blocks; width *= 2) {
    parallel_tasks(blocks / (2 * width), num_threads, [&](std::int64_t i) {
      std::inplace_merge(at(2 * i * width), at((2 * i + 1) * width), at((2 * i + 2) * width));
    });
  }
}

}  // namespace radarsdf
