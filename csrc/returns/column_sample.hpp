// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// A sample of space: columns of cells, of which a hash chooses a share. What lies in a sampled column is in the sample
// whatever else is there, so that different cells of many rays can be counted in a small part of them.
#pragma once

#include <cstdint>

namespace radarsdf {

struct ColumnSample {
  std::int64_t column;  // cells along an edge of a column
  double share;         // of all columns, in [0, 1]
};

// chosen: (count,), whether the cell with these lattice coordinates, (count, dims), is in the sample.
void sample_cells(const ColumnSample& sample, const std::int64_t* cells, std::int64_t count, int dims,
                  std::uint8_t* chosen, int num_threads);

// chosen: (count,), whether one of the points at these distances behind the returns is in the sample, by those of its
// coordinates that are asked for. points, directions: (count, 3), local frame, m; offsets_m: (num_offsets,); axes:
// (dims,).
void sample_rays(const ColumnSample& sample, double cell_size_m, const float* points, const float* directions,
                 std::int64_t count, const float* offsets_m, std::int64_t num_offsets, const int* axes, int dims,
                 std::uint8_t* chosen, int num_threads);

}  // namespace radarsdf
