// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "returns/smooth_distances.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/morton.hpp"
#include "returns/ray_average.hpp"
#include "util/parallel.hpp"
#include "util/stable_order.hpp"

namespace radarsdf {
namespace {

constexpr std::int64_t kBlock = 1 << 13;  // vertices or cells of a thread, at least
constexpr int kPlaces = 3;                // of a plane where its distance is known
constexpr double kBend = 2;               // leaf cells: second difference of a distance whose slope turns from -1 to 1
constexpr double kClear = 0.25;           // leaf cells: least distance of a vertex whose side is known

// A place where the distance is known, and the corners of the cell that it is in.
struct Place {
  float fraction[3];  // of the cell's edges
  float weight, target_m;

  std::array<float, 8> shares() const {  // bit `axis` of a corner: whether it is the upper one
    std::array<float, 8> found;
    for (int c = 0; c < 8; ++c) {
      float share = 1;
      for (int axis = 0; axis < 3; ++axis) share *= (c >> axis & 1) != 0 ? fraction[axis] : 1 - fraction[axis];
      found[static_cast<std::size_t>(c)] = share;
    }
    return found;
  }
};

class Plates {
 public:
  Plates(const VertexTable& table, const KnownPlanes& planes, int num_threads)
      : table_(&table), num_threads_(num_threads), vertices_(static_cast<std::size_t>(table.num_rows())) {
    place(planes);
    connect();
  }

  void relax(const std::int8_t* sides, int iterations, float* distances_m) {
    // Errors whose eigenvalues are in [least, 1] shrink to 1 / cosh(4). No eigenvalue is above 1: see
    // Vertex::stiffness.
    const float least = 4 / std::max(4.1F, static_cast<float>(iterations) * static_cast<float>(iterations));
    const float middle = (1 + least) / 2, half = (1 - least) / 2;
    const auto least_m = static_cast<float>(kClear * table_->leaf_size_m());
    std::vector<float> step(vertices_.size(), 0.0F);
    float rho = half / middle;
    for (int k = 0; k < iterations; ++k) {
      const float next = 1 / (2 * middle / half - rho);
      const float keep = k == 0 ? 0 : next * rho, gain = k == 0 ? 1 / middle : 2 * next / half;
      if (k > 0) rho = next;
      pull(distances_m);
      parallel_blocks(static_cast<std::int64_t>(vertices_.size()), kBlock, num_threads_,
                      [&](std::int64_t begin, std::int64_t end) {
                        for (auto v = static_cast<std::size_t>(begin); v < static_cast<std::size_t>(end); ++v) {
                          const Vertex& vertex = vertices_[v];
                          if (!(vertex.stiffness > 0)) continue;
                          const float before_m = distances_m[v];
                          float after_m = before_m + keep * step[v] - gain * (slope(vertex, v) / vertex.stiffness);
                          if (sides[v] == kInFront) after_m = std::max(after_m, least_m);
                          if (sides[v] == kBehind) after_m = std::min(after_m, -least_m);
                          step[v] = after_m - before_m;
                          distances_m[v] = after_m;
                        }
                      });
    }
  }

 private:
  struct Vertex {
    std::int32_t before[3] = {-1, -1, -1}, after[3] = {-1, -1, -1};  // neighbours along the axes
    std::int32_t pulls[8] = {-1, -1, -1, -1, -1, -1, -1, -1};        // by the cell whose corner c it is
    // The matrix is at most a diagonal of these: (sum of a x)^2 <= (sum of |a|) (sum of |a| x^2), row by row.
    float stiffness = 0;
  };

  const std::int32_t* rows_of(std::int32_t cell) const { return table_->cells()[static_cast<std::size_t>(cell)].rows; }

  // The places in the order of their cells, in each in the order of the planes.
  void place(const KnownPlanes& planes) {
    const std::int64_t count = kPlaces * planes.count;
    const double size_m = table_->leaf_size_m();
    std::vector<float> points(static_cast<std::size_t>(3 * count));
    for (std::int64_t i = 0; i < count; ++i) {
      const float *point = planes.points + 3 * (i / kPlaces), *normal = planes.normals + 3 * (i / kPlaces);
      const auto before_m = static_cast<float>(static_cast<double>(i % kPlaces - 1) * size_m);
      for (int axis = 0; axis < 3; ++axis)
        points[static_cast<std::size_t>(3 * i + axis)] = point[axis] + before_m * normal[axis];
    }
    std::vector<std::uint64_t> keys(static_cast<std::size_t>(count));
    cell_keys(points.data(), count, size_m, keys.data(), num_threads_);
    const CellBlocks leaves(table_->leaf_keys().data(), static_cast<std::int64_t>(table_->leaf_keys().size()));
    std::vector<std::int32_t> cells(static_cast<std::size_t>(count));
    leaves.rows(keys.data(), count, cells.data(), num_threads_);
    drop_beyond_thin_walls(planes, cells);
    const auto scale = static_cast<float>(kBend * kBend * size_m * size_m / kPlaces);
    for (const std::int32_t at : stable_order(keys.data(), count)) {
      const auto i = static_cast<std::size_t>(at);
      if (cells[i] < 0) continue;
      if (cells_.empty() || cells_.back() != cells[i]) {
        cells_.push_back(cells[i]);
        first_.push_back(places_.size());
      }
      Place& found = places_.emplace_back();
      for (int axis = 0; axis < 3; ++axis) {
        const auto cell = static_cast<std::int32_t>(morton_coordinate(keys[i], axis)) - kAxisBias;
        const double fraction = points[3 * i + static_cast<std::size_t>(axis)] / size_m - cell;
        found.fraction[axis] = static_cast<float>(std::clamp(fraction, 0.0, 1.0));
      }
      found.weight = scale * planes.information[i / kPlaces];
      found.target_m = static_cast<float>(static_cast<double>(at % kPlaces - 1) * size_m);
    }
    first_.push_back(places_.size());
  }

  // cells: of the places, -1 for those that do not count.
  void drop_beyond_thin_walls(const KnownPlanes& planes, std::vector<std::int32_t>& cells) const {
    std::vector<std::int64_t> plane_of(table_->leaf_keys().size(), -1);
    for (std::int64_t i = 0; i < planes.count; ++i) {
      const std::int32_t own = cells[static_cast<std::size_t>(kPlaces * i + 1)];
      if (own >= 0) plane_of[static_cast<std::size_t>(own)] = i;
    }
    for (std::int64_t i = 0; i < planes.count; ++i) {
      std::int32_t& behind = cells[static_cast<std::size_t>(kPlaces * i)];
      const std::int64_t other = behind >= 0 ? plane_of[static_cast<std::size_t>(behind)] : -1;
      if (other < 0) continue;
      const float *normal = planes.normals + 3 * i, *opposite = planes.normals + 3 * other;
      if (normal[0] * opposite[0] + normal[1] * opposite[1] + normal[2] * opposite[2] < 0) behind = -1;
    }
  }

  // Neighbours are vertices of the same cell.
  void connect() {
    const auto num_leaves = static_cast<std::int32_t>(table_->leaf_keys().size());
    for (std::int32_t cell = 0; cell < num_leaves; ++cell) {
      const std::int32_t* rows = rows_of(cell);
      for (int c = 0; c < 8; ++c) {
        for (int axis = 0; axis < 3; ++axis) {
          const std::int32_t other = rows[c ^ 1 << axis];
          Vertex& vertex = vertices_[static_cast<std::size_t>(rows[c])];
          ((c >> axis & 1) != 0 ? vertex.before : vertex.after)[axis] = other;
        }
      }
    }
    pulls_.resize(8 * cells_.size());
    for (std::size_t i = 0; i < cells_.size(); ++i) {
      const std::int32_t* rows = rows_of(cells_[i]);
      for (int c = 0; c < 8; ++c)
        vertices_[static_cast<std::size_t>(rows[c])].pulls[c] = static_cast<std::int32_t>(8 * i) + c;
    }
    // pulls_ holds the weights for now.
    for_each_cell([&](std::size_t i, float* weights) {
      std::fill_n(weights, 8, 0.0F);
      for (std::size_t k = first_[i]; k < first_[i + 1]; ++k) {
        const std::array<float, 8> shares = places_[k].shares();
        for (std::size_t c = 0; c < 8; ++c) weights[c] += places_[k].weight * shares[c];
      }
    });
    for (Vertex& vertex : vertices_) {
      for (const std::int32_t pull : vertex.pulls)
        vertex.stiffness += pull >= 0 ? pulls_[static_cast<std::size_t>(pull)] : 0;
      for (int axis = 0; axis < 3; ++axis) {
        vertex.stiffness += is_bent(vertex, axis) ? 8.0F : 0.0F;
        for (const std::int32_t other : {vertex.before[axis], vertex.after[axis]}) {
          if (other >= 0 && is_bent(vertices_[static_cast<std::size_t>(other)], axis)) vertex.stiffness += 4;
        }
      }
    }
    for (std::vector<float>& bends : bends_) bends.assign(vertices_.size(), 0.0F);
  }

  static bool is_bent(const Vertex& vertex, int axis) { return vertex.before[axis] >= 0 && vertex.after[axis] >= 0; }

  template <typename Visit>
  void for_each_cell(const Visit& visit) {
    parallel_blocks(static_cast<std::int64_t>(cells_.size()), kBlock, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto i = static_cast<std::size_t>(begin); i < static_cast<std::size_t>(end); ++i)
                        visit(i, pulls_.data() + 8 * i);
                    });
  }

  // What the places of each cell, and each axis, say at these distances.
  void pull(const float* distances_m) {
    for_each_cell([&](std::size_t i, float* pulls) {
      const std::int32_t* rows = rows_of(cells_[i]);
      float corners_m[8];
      for (int c = 0; c < 8; ++c) corners_m[c] = distances_m[rows[c]];
      std::fill_n(pulls, 8, 0.0F);
      for (std::size_t k = first_[i]; k < first_[i + 1]; ++k) {
        const std::array<float, 8> shares = places_[k].shares();
        float off_m = -places_[k].target_m;
        for (std::size_t c = 0; c < 8; ++c) off_m += shares[c] * corners_m[c];
        off_m *= places_[k].weight;
        for (std::size_t c = 0; c < 8; ++c) pulls[c] += off_m * shares[c];
      }
    });
    parallel_blocks(static_cast<std::int64_t>(vertices_.size()), kBlock, num_threads_,
                    [&](std::int64_t begin, std::int64_t end) {
                      for (auto v = static_cast<std::size_t>(begin); v < static_cast<std::size_t>(end); ++v) {
                        for (int axis = 0; axis < 3; ++axis) {
                          const Vertex& vertex = vertices_[v];
                          if (!is_bent(vertex, axis)) continue;
                          bends_[static_cast<std::size_t>(axis)][v] =
                              distances_m[vertex.before[axis]] + distances_m[vertex.after[axis]] - 2 * distances_m[v];
                        }
                      }
                    });
  }

  float slope(const Vertex& vertex, std::size_t v) const {
    float sum = 0;
    for (const std::int32_t pull : vertex.pulls) sum += pull >= 0 ? pulls_[static_cast<std::size_t>(pull)] : 0;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const std::vector<float>& bends = bends_[axis];
      const std::int32_t before = vertex.before[axis], after = vertex.after[axis];
      sum += (before >= 0 ? bends[static_cast<std::size_t>(before)] : 0) +
             (after >= 0 ? bends[static_cast<std::size_t>(after)] : 0) - 2 * bends[v];
    }
    return sum;
  }

  const VertexTable* table_;
  int num_threads_;
  std::vector<Vertex> vertices_;
  std::vector<std::int32_t> cells_;  // with places
  std::vector<std::size_t> first_;   // place of each of them, and their number
  std::vector<Place> places_;
  std::vector<float> pulls_;                 // (cells_.size(), 8)
  std::array<std::vector<float>, 3> bends_;  // second differences along each axis, 0 where there are none
};

}  // namespace

void smooth_distances(const VertexTable& table, const KnownPlanes& planes, const std::int8_t* sides, int iterations,
                      float* distances_m, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  Plates(table, planes, num_threads).relax(sides, iterations, distances_m);
}

}  // namespace radarsdf
