// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "vertex_table.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "cell_set.hpp"
#include "morton.hpp"
#include "parallel.hpp"
#include "prefetch.hpp"

namespace radarsdf {
namespace {

// The corners of a cell that carry features of their own: on one plane of the tri-quadtree (the axis that the plane
// leaves out is zero in every key, so cells of one column share vertices), or in space.
struct VertexGroup {
  std::array<bool, 3> uses_axis;
  int num_corners;

  std::uint64_t project(std::uint64_t cell_key) const {
    std::uint64_t key = 0;
    for (int axis = 0; axis < 3; ++axis) {
      if (uses_axis[static_cast<std::size_t>(axis)]) key |= spread_bits(morton_coordinate(cell_key, axis)) << axis;
    }
    return key;
  }

  // Corner c of a projected cell: bit i of c steps along the i-th axis that is used.
  std::uint64_t corner(std::uint64_t projected_key, int c) const {
    std::uint64_t key = 0;
    int bit = 0;
    for (int axis = 0; axis < 3; ++axis) {
      if (!uses_axis[static_cast<std::size_t>(axis)]) continue;
      const std::uint32_t step = static_cast<std::uint32_t>(c >> bit++) & 1u;
      key |= spread_bits(morton_coordinate(projected_key, axis) + step) << axis;
    }
    return key;
  }
};

const std::vector<VertexGroup>& vertex_groups(Encoding encoding) {
  static const std::vector<VertexGroup> planes = {
      {{true, true, false}, 4}, {{true, false, true}, 4}, {{false, true, true}, 4}};
  static const std::vector<VertexGroup> space = {{{true, true, true}, 8}};
  return encoding == Encoding::kTriQuadtree ? planes : space;
}

void sort_unique(std::vector<std::uint64_t>& keys, int num_threads) {
  parallel_sort(keys, num_threads);
  keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
}

// Gives every vertex of the group at this level a row, from first_row on, and writes the rows into the cells at
// slot `first_corner`. Returns the number of vertices.
std::int64_t assign_rows(const VertexGroup& group, const std::vector<std::uint64_t>& keys, Cell* cells,
                         int first_corner, std::int64_t first_row, int num_threads) {
  std::vector<std::uint64_t> projected(keys.size());
  const auto count = static_cast<std::int64_t>(keys.size());
  parallel_blocks(count, 1 << 13, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (auto i = static_cast<std::size_t>(begin); i < static_cast<std::size_t>(end); ++i)
      projected[i] = group.project(keys[i]);
  });
  std::vector<std::uint64_t> columns = projected;
  sort_unique(columns, num_threads);

  check_interrupt();
  std::vector<std::uint64_t> vertices;
  vertices.reserve(columns.size() * static_cast<std::size_t>(group.num_corners));
  for (const std::uint64_t column : columns) {
    for (int c = 0; c < group.num_corners; ++c) vertices.push_back(group.corner(column, c));
  }
  sort_unique(vertices, num_threads);
  const auto num_vertices = static_cast<std::int64_t>(vertices.size());
  if (first_row + num_vertices > std::numeric_limits<std::int32_t>::max()) {
    throw std::invalid_argument("the map needs more than 2^31 vertices: use larger cells");
  }

  check_interrupt();
  FlatMap row_of(vertices.size());
  for (std::size_t i = 0; i < vertices.size(); ++i)
    row_of.insert(vertices[i], static_cast<std::int32_t>(first_row) + static_cast<std::int32_t>(i));
  parallel_blocks(count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      for (int c = 0; c < group.num_corners; ++c) {
        cells[i].rows[first_corner + c] = row_of.find(group.corner(projected[static_cast<std::size_t>(i)], c));
      }
    }
  });
  return num_vertices;
}

// Cells of the next coarser level, and the links of the parents to the children.
std::vector<std::uint64_t> parents_of(const std::vector<std::uint64_t>& keys) {
  std::vector<std::uint64_t> parents;
  for (const std::uint64_t key : keys) {
    if (parents.empty() || parents.back() != key >> 3) parents.push_back(key >> 3);
  }
  return parents;
}

// Without SSE4.1 (the baseline) std::floor is a library call.
template <typename T>
std::int32_t floor_to_int(T value) {
  const auto truncated = static_cast<std::int32_t>(value);
  return truncated - static_cast<std::int32_t>(value < static_cast<T>(truncated));
}

inline int count_bits(std::uint32_t eight_bits) {
  std::uint32_t v = eight_bits - ((eight_bits >> 1) & 0x55u);
  v = (v & 0x33u) + ((v >> 2) & 0x33u);
  return static_cast<int>((v + (v >> 4)) & 0x0fu);
}

}  // namespace

VertexTable::VertexTable(std::vector<std::uint64_t> leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
                         int num_threads)
    : leaf_keys_(std::move(leaf_keys)), leaf_size_m_(leaf_size_m), num_levels_(num_levels), encoding_(encoding) {
  if (!(leaf_size_m > 0) || !std::isfinite(leaf_size_m))
    throw std::invalid_argument("leaf_size_m must be positive and finite");
  if (num_levels < 1 || num_levels > kMaxLevels) throw std::invalid_argument("num_levels must be 1 to 12");
  for (std::size_t i = 0; i < leaf_keys_.size(); ++i) {
    if (i > 0 && leaf_keys_[i - 1] >= leaf_keys_[i])
      throw std::invalid_argument("leaf_keys must be ascending and unique");
    for (int axis = 0; axis < 3; ++axis) {
      // The far vertex of a cell, at every level, must fit its key.
      if (leaf_keys_[i] >> 63 || morton_coordinate(leaf_keys_[i], axis) >= (1u << kAxisBits) - (1u << num_levels)) {
        throw std::invalid_argument("leaf_keys holds a cell outside the lattice");
      }
    }
  }

  std::vector<std::vector<std::uint64_t>> keys = {leaf_keys_};
  for (int level = 1; level < num_levels; ++level) keys.push_back(parents_of(keys.back()));
  std::size_t total = 0;
  for (const auto& level_keys : keys) total += level_keys.size();
  if (total > static_cast<std::size_t>(std::numeric_limits<std::int32_t>::max())) {
    throw std::invalid_argument("the map needs more than 2^31 cells: use larger cells");
  }
  cells_.assign(total, Cell{});

  std::size_t first = 0;
  for (const auto& level_keys : keys) {
    Cell* level_cells = cells_.data() + first;
    int corner = 0;
    for (const VertexGroup& group : vertex_groups(encoding)) {
      num_rows_ += assign_rows(group, level_keys, level_cells, corner, num_rows_, num_threads);
      corner += group.num_corners;
    }
    if (&level_keys != &keys.back()) {
      // Children of one parent are neighbours in Morton order, and parents follow each other as their children do.
      Cell* parent = level_cells + level_keys.size();
      for (std::size_t i = 0; i < level_keys.size(); ++i) {
        if (i > 0 && level_keys[i] >> 3 != level_keys[i - 1] >> 3) ++parent;
        if (parent->child_mask == 0) parent->first_child = static_cast<std::int32_t>(first + i);
        parent->child_mask |= 1u << (level_keys[i] & 7);
      }
    }
    first += level_keys.size();
  }
  roots_ = FlatMap(keys.back().size());
  const std::size_t first_root = total - keys.back().size();
  for (std::size_t i = 0; i < keys.back().size(); ++i) {
    roots_.insert(keys.back()[i], static_cast<std::int32_t>(first_root + i));
  }
}

template <typename T>
void VertexTable::locate(const T* points, std::int64_t count, std::int32_t* cells) const {
  const FlatMapView roots = roots_.view();
  const T inverse = static_cast<T>(1.0 / leaf_size_m_), limit = static_cast<T>(kAxisBias);
  const int coarsest = num_levels_ - 1;
  // In stages over a block that stays in the first-level cache, so that the misses of many points overlap.
  constexpr std::int64_t kBlock = 64;
  std::uint32_t leaf[kBlock][3];
  std::uint64_t root_key[kBlock];
  for (std::int64_t first = 0; first < count; first += kBlock) {
    const std::int64_t size = std::min(kBlock, count - first);
    for (std::int64_t i = 0; i < size; ++i) {
      const T* p = points + 3 * (first + i);
      const T u[3] = {p[0] * inverse, p[1] * inverse, p[2] * inverse};
      root_key[i] = kEmptyKey;
      if (!(std::abs(u[0]) < limit && std::abs(u[1]) < limit && std::abs(u[2]) < limit)) continue;
      for (int axis = 0; axis < 3; ++axis)
        leaf[i][axis] = static_cast<std::uint32_t>(floor_to_int(u[axis]) + kAxisBias);
      root_key[i] = morton_key(leaf[i][0] >> coarsest, leaf[i][1] >> coarsest, leaf[i][2] >> coarsest);
      prefetch(&roots.slots[roots.home(root_key[i])]);
    }
    for (std::int64_t i = 0; i < size; ++i) {
      const std::int32_t root = root_key[i] == kEmptyKey ? -1 : roots.find(root_key[i]);
      cells[(first + i) * num_levels_ + coarsest] = root;
      if (root >= 0) prefetch(&cells_[static_cast<std::size_t>(root)]);
    }
    for (int level = coarsest; level-- > 0;) {
      for (std::int64_t i = 0; i < size; ++i) {
        std::int32_t* found = cells + (first + i) * num_levels_ + level;
        found[0] = -1;
        if (found[1] < 0) continue;
        const Cell& parent = cells_[static_cast<std::size_t>(found[1])];
        const auto bit = [&](int axis) { return leaf[i][axis] >> level & 1u; };
        const std::uint32_t child = bit(0) | bit(1) << 1 | bit(2) << 2;
        if (!(parent.child_mask >> child & 1u)) continue;
        found[0] = parent.first_child + count_bits(parent.child_mask & ((1u << child) - 1));
        prefetch(&cells_[static_cast<std::size_t>(found[0])]);
      }
    }
  }
}

std::vector<std::int32_t> leaf_coordinates(const std::vector<std::uint64_t>& leaf_keys) {
  std::vector<std::int32_t> coordinates;
  coordinates.reserve(3 * leaf_keys.size());
  for (const std::uint64_t key : leaf_keys) {
    for (int axis = 0; axis < 3; ++axis)
      coordinates.push_back(static_cast<std::int32_t>(morton_coordinate(key, axis)) - kAxisBias);
  }
  return coordinates;
}

template void VertexTable::locate(const float*, std::int64_t, std::int32_t*) const;
template void VertexTable::locate(const double*, std::int64_t, std::int32_t*) const;

}  // namespace radarsdf
