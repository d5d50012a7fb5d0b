// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/column_sample.hpp"

#include <cmath>

#include "lattice/flat_map.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

class Chooser {
 public:
  explicit Chooser(const ColumnSample& sample)
      : column_(sample.column), limit_(static_cast<std::uint64_t>(sample.share * (1 << 24))) {}

  bool chooses(const std::int64_t* cell, int dims) const {
    std::uint64_t hash = 0;
    for (int i = 0; i < dims; ++i) {
      const std::int64_t column = cell[i] / column_ - (cell[i] % column_ < 0 ? 1 : 0);  // rounded down
      hash = hash_key(hash ^ static_cast<std::uint64_t>(column));
      hash ^= hash >> 29;
    }
    return hash >> 40 < limit_;
  }

 private:
  std::int64_t column_;
  std::uint64_t limit_;
};

}  // namespace

void sample_cells(const ColumnSample& sample, const std::int64_t* cells, std::int64_t count, int dims,
                  std::uint8_t* chosen, int num_threads) {
  const Chooser chooser(sample);
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) chosen[i] = chooser.chooses(cells + dims * i, dims) ? 1 : 0;
  });
}

void sample_rays(const ColumnSample& sample, double cell_size_m, const float* points, const float* directions,
                 std::int64_t count, const float* offsets_m, std::int64_t num_offsets, const int* axes, int dims,
                 std::uint8_t* chosen, int num_threads) {
  const Chooser chooser(sample);
  const auto size_m = static_cast<float>(cell_size_m);
  parallel_blocks(count, 1 << 13, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      chosen[i] = 0;
      for (std::int64_t k = 0; k < num_offsets && chosen[i] == 0; ++k) {
        std::int64_t cell[3] = {};
        for (int a = 0; a < dims; ++a) {
          const float at = points[3 * i + axes[a]] + offsets_m[k] * directions[3 * i + axes[a]];
          cell[a] = static_cast<std::int64_t>(std::floor(at / size_m));
        }
        chosen[i] = chooser.chooses(cell, dims) ? 1 : 0;
      }
    }
  });
}

}  // namespace radarsdf
