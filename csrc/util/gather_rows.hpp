#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "util/parallel.hpp"
#include "util/prefetch.hpp"

namespace radarsdf {

// Matrix of `width` columns in C order.
template <typename T>
struct Block {
  const T* data;
  std::int64_t width;
};

// Gathers rows of blocks in this order and concatenates them: out (count, sum of the widths).
template <typename T>
void gather_rows(const std::vector<Block<T>>& blocks, const std::int32_t* order, std::int64_t count, T* out,
                 int num_threads) {
  constexpr std::int64_t ahead = 16;  // prefetch distance: scattered rows are cache misses
  std::int64_t columns = 0;
  for (const Block<T>& block : blocks) columns += block.width;
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    T* to = out + begin * columns;
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t row = order[i], later = order[std::min(i + ahead, end - 1)];
      for (const Block<T>& block : blocks) {
        prefetch(block.data + later * block.width);
        to = std::copy_n(block.data + row * block.width, block.width, to);
      }
    }
  });
}

}  // namespace radarsdf
