#include "returns/cell_means.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <stdexcept>
#include <utility>

#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/prefetch.hpp"

namespace radarsdf {
namespace {

constexpr double kDirectionOffset = 0.37;  // keeps bin edges off the axes of the world
constexpr double kFarthestCell = 1e15;     // index of all farther coordinates and of NaN
constexpr int kViewsPerCell = 3;           // estimate; growing a table takes longer than filling it
constexpr double kCauchyMedians = 2.0;     // scale of the Cauchy weight, in median absolute values

std::uint64_t cell_of(double place) {
  if (!(std::abs(place) < kFarthestCell)) place = kFarthestCell;
  return static_cast<std::uint64_t>(floor_to_int<std::int64_t>(place));
}

// Packs three coordinates into one number, unique for cells less than 2^20 from the origin.
std::uint64_t cell_of(const float* vector, double per_unit, double offset) {
  const std::uint64_t x = cell_of(vector[0] * per_unit + offset);
  const std::uint64_t y = cell_of(vector[1] * per_unit + offset);
  const std::uint64_t z = cell_of(vector[2] * per_unit + offset);
  return x + (y << 21) + (z << 42);
}

// Maps views to keys of the cells of one kind in one tiling.
class Tiles {
 public:
  Tiles(const CellKind& kind, int number, double offset)
      : seed_(hash_key(static_cast<std::uint64_t>(number) + 1)),
        offset_(offset),
        per_m_(1 / kind.edge_m),
        per_direction_(kind.direction_step > 0 ? 1 / kind.direction_step : 0),
        per_rad_(kind.incidence_step_rad > 0 ? 1 / kind.incidence_step_rad : 0) {}

  // Of 63 bits, so none equals kEmptyKey. Among a million cells, a collision has a probability of 1e-7.
  std::uint64_t key(const Views& views, std::int64_t i) const {
    std::uint64_t hash = mixed(seed_, cell_of(views.points + 3 * i, per_m_, offset_));
    if (per_direction_ > 0) {
      hash = mixed(hash, cell_of(views.directions + 3 * i, per_direction_, offset_ + kDirectionOffset));
    }
    if (per_rad_ > 0) {
      const double angle = views.incidence_rad[i];
      hash = mixed(hash, cell_of(std::isnan(angle) ? -2.0 : angle * per_rad_ + offset_));  // no angle is in bin -2
    }
    return hash >> 1;
  }

 private:
  std::uint64_t seed_;
  double offset_, per_m_, per_direction_, per_rad_;
};

Tiles tiles_of(const CellKind& kind, std::size_t kind_number, std::size_t num_kinds, int tiling, int num_tilings) {
  const int number = tiling * static_cast<int>(num_kinds) + static_cast<int>(kind_number);
  return {kind, number, static_cast<double>(tiling) / num_tilings};
}

// Numbers the cells of the views from 0 in order of first occurrence, and appends their keys.
std::int64_t number_cells(const Tiles& tiles, const Views& views, std::int32_t* rows,
                          std::vector<std::uint64_t>* keys) {
  FlatMap numbers(views.count / kViewsPerCell);
  std::int32_t next = 0;
  // With millions of views, almost every look-up is a cache miss: prefetching in batches overlaps them.
  std::uint64_t run[64];
  constexpr std::int64_t size = std::size(run);
  for (std::int64_t first = 0; first < views.count; first += size) {
    const std::int64_t end = std::min(first + size, views.count);
    const FlatMapView table = numbers.view();
    for (std::int64_t i = first; i < end; ++i) {
      run[i - first] = tiles.key(views, i);
      prefetch(table.slots + table.home(run[i - first]));
    }
    for (std::int64_t i = first; i < end; ++i) {
      rows[i] = numbers.find_or_insert(run[i - first], next);
      if (rows[i] < next) continue;
      ++next;
      if (keys != nullptr) keys->push_back(run[i - first]);
    }
  }
  return next;
}

double median_absolute(const std::vector<double>& values) {
  std::vector<double> sizes(values.size());
  std::transform(values.begin(), values.end(), sizes.begin(), [](double v) { return std::abs(v); });
  const auto middle = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
  std::nth_element(sizes.begin(), middle, sizes.end());
  return *middle;
}

// State of a cell in one struct: with millions of cells, each access is a cache miss.
struct Cell {
  double sum = 0;  // weighted
  float mass = 0, mean = 0;
};

CellMeans fit_tiling(const std::vector<CellKind>& kinds, int tiling, int num_tilings, const Views& views,
                     const float* values, const float* weights, const CellMeanOptions& options) {
  const std::size_t count = views.count;
  const int rounds = options.rounds;
  CellMeans result;
  std::vector<std::int32_t> rows(kinds.size() * count);
  std::vector<std::size_t> firsts;  // index of the first cell of each kind, and the end
  for (std::size_t k = 0; k < kinds.size(); ++k) {
    check_interrupt();
    firsts.push_back(result.keys.size());
    number_cells(tiles_of(kinds[k], k, kinds.size(), tiling, num_tilings), views, &rows[k * count], &result.keys);
  }
  firsts.push_back(result.keys.size());

  std::vector<double> left(values, values + count);
  std::vector<float> reweighted;
  std::vector<Cell> cells(result.keys.size());
  // The residuals of a sweep are updated in the next one, which saves half of the passes over them.
  std::vector<double> decreases;  // of the means of the last kind
  const std::int32_t* last_row = nullptr;
  const auto update = [&](std::size_t i) {
    if (last_row != nullptr) left[i] += decreases[last_row[i]];
    return left[i];
  };
  for (int round = 0; round < rounds; ++round) {
    for (std::size_t k = 0; k < kinds.size(); ++k) {
      check_interrupt();
      const std::int32_t* row = &rows[k * count];
      Cell* own = cells.data() + firsts[k];
      Cell* end = cells.data() + firsts[k + 1];
      for (Cell* cell = own; cell != end; ++cell) cell->sum = cell->mass = 0;
      for (std::size_t i = 0; i < count; ++i) {
        Cell& cell = own[row[i]];
        cell.sum += double{weights[i]} * (update(i) + double{cell.mean});
        cell.mass += weights[i];
      }
      decreases.clear();
      for (Cell* cell = own; cell != end; ++cell) {
        const auto mean = static_cast<float>(cell->sum / (double{cell->mass} + options.shrinkage));
        decreases.push_back(double{cell->mean} - double{mean});
        cell->mean = mean;
      }
      last_row = row;
    }
    for (std::size_t i = 0; i < count; ++i) update(i);
    last_row = nullptr;
    if (round == 0 && rounds > 1) {
      const double scale = kCauchyMedians * median_absolute(left);
      if (!(scale > 0)) continue;
      reweighted.resize(count);
      for (std::size_t i = 0; i < count; ++i) {
        const double relative = left[i] / scale;
        reweighted[i] = static_cast<float>(double{weights[i]} / std::sqrt(1 + relative * relative));
      }
      weights = reweighted.data();
    }
  }
  result.explained.reserve(count);
  for (std::size_t i = 0; i < count; ++i) {
    result.explained.push_back(static_cast<float>(double{values[i]} - left[i]));
  }
  std::size_t kept = 0;
  for (std::size_t i = 0; i < cells.size(); ++i) {
    if (std::abs(cells[i].mean) < options.least_mean) continue;
    result.keys[kept++] = result.keys[i];
    result.means.push_back(cells[i].mean);
  }
  result.keys.resize(kept);
  result.keys.shrink_to_fit();
  return result;
}

}  // namespace

std::int64_t cell_rows(const CellKind& kind, const Views& views, std::int32_t* rows) {
  return number_cells(tiles_of(kind, 0, 1, 0, 1), views, rows, nullptr);
}

CellMeans fit_cell_means(const std::vector<CellKind>& kinds, int num_tilings, const Views& views, const float* values,
                         const float* weights, const CellMeanOptions& options, int num_threads) {
  CellMeans all;
  if (views.count == 0 || kinds.empty()) return all;
  std::vector<CellMeans> parts(num_tilings);
  parallel_tasks(num_tilings, num_threads, [&](std::int64_t t) {
    parts[t] = fit_tiling(kinds, static_cast<int>(t), num_tilings, views, values, weights, options);
  });
  std::size_t num_means = 0;
  for (const CellMeans& part : parts) num_means += part.means.size();
  all.keys.reserve(num_means);
  all.means.reserve(num_means);
  all.explained.reserve(views.count);
  for (std::int64_t i = 0; i < views.count; ++i) {
    double sum = 0;
    for (const CellMeans& part : parts) sum += double{part.explained[i]};
    all.explained.push_back(static_cast<float>(sum / num_tilings));
  }
  for (CellMeans& part : parts) {
    all.keys.insert(all.keys.end(), part.keys.begin(), part.keys.end());
    all.means.insert(all.means.end(), part.means.begin(), part.means.end());
    part = {};
  }
  return all;
}

CellMeansAt::CellMeansAt(std::vector<CellKind> kinds, int num_tilings, const std::uint64_t* keys, const float* means,
                         std::int64_t count)
    : kinds_(std::move(kinds)), num_tilings_(num_tilings), means_(means, means + count), rows_(count) {
  for (std::int64_t i = 0; i < count; ++i) {
    if (keys[i] == kEmptyKey || !rows_.insert(keys[i], static_cast<std::int32_t>(i))) {
      throw std::invalid_argument("keys must be different keys of cells");
    }
  }
}

void CellMeansAt::sums(const Views& views, float* sums, int num_threads) const {
  constexpr std::int64_t kMinBlock = 1 << 10;
  std::vector<Tiles> tiles;
  for (int t = 0; t < num_tilings_; ++t) {
    for (std::size_t k = 0; k < kinds_.size(); ++k) {
      tiles.push_back(tiles_of(kinds_[k], k, kinds_.size(), t, num_tilings_));
    }
  }
  parallel_blocks(views.count, kMinBlock, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      double sum = 0;
      for (const Tiles& tile : tiles) {
        const std::int32_t row = rows_.find(tile.key(views, i));
        if (row >= 0) sum += means_[row];
      }
      sums[i] = static_cast<float>(sum / num_tilings_);
    }
  });
}

}  // namespace radarsdf
