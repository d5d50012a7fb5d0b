// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// A quantity of returns as a sum of means in cells of several kinds, from coarse to fine, in space and by the view.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"

namespace radarsdf {

// Cells of one kind. Their bins of direction and incidence are as wide as these steps; 0: they do not distinguish it.
struct CellKind {
  double edge_m;
  double direction_step;  // of each component of the unit vector
  double incidence_step_rad;
};

// Returns, or groups of returns, of which cells are asked. Positions in the local frame, m.
struct Views {
  const float* points;         // (count, 3)
  const float* directions;     // (count, 3), unit vectors from the sensor
  const float* incidence_rad;  // (count,), NaN where it is not known
  std::int64_t count;
};

// The cells of all kinds lie in tilings. Tiling t of T is moved by t / T of a cell along each axis, so the edges of
// cells are in other places, and the mean of the tilings is smoother than each.
struct CellMeans {
  std::vector<std::uint64_t> keys;  // of a cell: a hash of its tiling, kind and place
  std::vector<float> means;
  std::vector<float> explained;  // of each value, by the means of its cells, averaged over the tilings
};

// rows: (count,), for each view the number of its cell of this kind; cells are numbered as they first occur. Returns
// how many there are.
std::int64_t cell_rows(const CellKind& kind, const Views& views, std::int32_t* rows);

struct CellMeanOptions {
  double shrinkage;  // a mean of weight n counts n / (n + shrinkage)
  int rounds;
  float least_mean;  // smaller ones are left out of what is found
};

// Splits `values` (count,) into means in the cells, tiling by tiling. Each kind takes the means of what the others
// leave, in turn, some rounds long. After the first a value that is far off has less weight (Cauchy). The same bits
// with any number of threads.
CellMeans fit_cell_means(const std::vector<CellKind>& kinds, int num_tilings, const Views& views, const float* values,
                         const float* weights, const CellMeanOptions& options, int num_threads);

// Answers from means of cells.
class CellMeansAt {
 public:
  // Throws std::invalid_argument where a key occurs twice.
  CellMeansAt(std::vector<CellKind> kinds, int num_tilings, const std::uint64_t* keys, const float* means,
              std::int64_t count);

  // sums: (count,), the means of each view's cells, added over the kinds and averaged over the tilings. A cell without
  // a mean counts 0.
  void sums(const Views& views, float* sums, int num_threads) const;

 private:
  std::vector<CellKind> kinds_;
  int num_tilings_;
  std::vector<float> means_;
  FlatMap rows_;
};

}  // namespace radarsdf
