// Additive model of a quantity of returns: means in cells of several kinds, by position and view, coarse to fine.
#pragma once

#include <cstdint>
#include <vector>

#include "lattice/flat_map.hpp"

namespace radarsdf {

// Cells of one kind, with bin widths of direction and incidence; 0: not binned.
struct CellKind {
  double edge_m;
  double direction_step;  // per component of the unit vector
  double incidence_step_rad;
};

// Queries: returns, or groups of returns. Positions in the local frame, m.
struct Views {
  const float* points;         // (count, 3)
  const float* directions;     // (count, 3), unit vectors from the sensor
  const float* incidence_rad;  // (count,), NaN if unknown
  std::int64_t count;
};

// Cells of all kinds come in tilings. Tiling t of T is shifted by t / T of a cell along each axis, so that the mean
// over tilings is smoother than each.
struct CellMeans {
  std::vector<std::uint64_t> keys;  // hashes of tiling, kind and position of cells
  std::vector<float> means;
  std::vector<float> explained;  // prediction of each value, averaged over the tilings
};

// rows: (count,), the cell of each view for one kind, numbered in order of first occurrence. Returns the number of
// cells.
std::int64_t cell_rows(const CellKind& kind, const Views& views, std::int32_t* rows);

struct CellMeanOptions {
  double shrinkage;  // means of weight n are multiplied by n / (n + shrinkage)
  int rounds;
  float least_mean;  // smaller means are dropped
};

// Decomposes `values` (count,) into cell means, for each tiling by backfitting: each kind in turn takes the means of
// the residuals of the others, for some rounds, with Cauchy weights after the first. Independent of the number of
// threads.
CellMeans fit_cell_means(const std::vector<CellKind>& kinds, int num_tilings, const Views& views, const float* values,
                         const float* weights, const CellMeanOptions& options, int num_threads);

// Predictions from cell means.
class CellMeansAt {
 public:
  // Throws std::invalid_argument for a duplicate key.
  CellMeansAt(std::vector<CellKind> kinds, int num_tilings, const std::uint64_t* keys, const float* means,
              std::int64_t count);

  // sums: (count,), the means of each view's cells, summed over the kinds and averaged over the tilings; 0 for cells
  // without a mean.
  void sums(const Views& views, float* sums, int num_threads) const;

 private:
  std::vector<CellKind> kinds_;
  int num_tilings_;
  std::vector<float> means_;
  FlatMap rows_;
};

}  // namespace radarsdf
