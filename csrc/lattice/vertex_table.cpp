// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "lattice/vertex_table.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <utility>

#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/parallel_sort.hpp"
#include "util/prefetch.hpp"

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

// Cells or vertices by blocks of 4 x 4 x 4: a bit for each. What is in a block, and its vertices, are a few operations
// on one number.
class BlockMasks {
 public:
  explicit BlockMasks(std::size_t expected_blocks) : numbers_(expected_blocks) {}

  void add(std::uint64_t block_key, std::uint64_t mask) {
    if (mask == 0) return;
    std::int32_t found = numbers_.find(block_key);
    if (found < 0) {
      found = static_cast<std::int32_t>(blocks_.size());
      blocks_.push_back({block_key, {0, 0}});
      numbers_.insert(block_key, found);
    }
    blocks_[static_cast<std::size_t>(found)].parts.mask |= mask;
  }

  // Numbers what is there from `first_row` on, in the order of the keys, and returns how much that is.
  std::int64_t number(std::int64_t first_row, int num_threads) {
    std::vector<std::uint64_t> keys;
    keys.reserve(blocks_.size());
    std::int64_t count = 0;
    for (const Block& block : blocks_) {
      keys.push_back(block.key);
      count += count_bits(block.parts.mask);
    }
    if (first_row + count > std::numeric_limits<std::int32_t>::max()) {
      throw std::invalid_argument("the map needs more than 2^31 vertices: use larger cells");
    }
    parallel_sort(keys, num_threads);
    std::int64_t row = first_row;
    for (const std::uint64_t key : keys) {
      Occupancy& parts = blocks_[static_cast<std::size_t>(numbers_.find(key))].parts;
      parts.first = static_cast<std::int32_t>(row);
      row += count_bits(parts.mask);
    }
    return count;
  }

  const Occupancy* find(std::uint64_t block_key) const {
    const std::int32_t found = numbers_.find(block_key);
    return found >= 0 ? &blocks_[static_cast<std::size_t>(found)].parts : nullptr;
  }

  struct Block {
    std::uint64_t key;
    Occupancy parts;
  };
  const std::vector<Block>& blocks() const { return blocks_; }

 private:
  FlatMap numbers_;
  std::vector<Block> blocks_;
};

// The parts of a block that lie at even places along an axis (0 and 2), at place 1, and at place 3. A part's place is
// two bits of its Morton number: bit `axis` is the low one and bit `axis + 3` the high one.
constexpr std::uint64_t parts_where(int axis, bool low_bit, bool any_high_bit, bool high_bit) {
  std::uint64_t mask = 0;
  for (int i = 0; i < 64; ++i) {
    if ((i >> axis & 1) == low_bit && (any_high_bit || (i >> (axis + 3) & 1) == high_bit))
      mask |= std::uint64_t{1} << i;
  }
  return mask;
}
constexpr std::uint64_t kEven[3] = {parts_where(0, false, true, false), parts_where(1, false, true, false),
                                    parts_where(2, false, true, false)};
constexpr std::uint64_t kOne[3] = {parts_where(0, true, false, false), parts_where(1, true, false, false),
                                   parts_where(2, true, false, false)};
constexpr std::uint64_t kThree[3] = {parts_where(0, true, false, true), parts_where(1, true, false, true),
                                     parts_where(2, true, false, true)};

// All parts one further along the axis: those that stay in the block, and those that are in the next one.
std::uint64_t shifted(std::uint64_t mask, int axis) {
  return (mask & kEven[axis]) << (1 << axis) | (mask & kOne[axis]) << (7 << axis);
}
std::uint64_t carried(std::uint64_t mask, int axis) { return (mask & kThree[axis]) >> (9 << axis); }

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
  BlockMasks columns(0);
  for (std::size_t i = 0; i < projected.size();) {
    const std::uint64_t block_key = CellBlocks::block_key(projected[i]);
    std::uint64_t mask = 0;
    for (; i < projected.size() && CellBlocks::block_key(projected[i]) == block_key; ++i) {
      mask |= std::uint64_t{1} << (projected[i] & 63);
    }
    columns.add(block_key, mask);
  }

  check_interrupt();
  const int num_corners = group.num_corners;
  BlockMasks vertices(2 * columns.blocks().size());
  for (const BlockMasks::Block& block : columns.blocks()) {
    // Parts of the block itself and of those after it, numbered as the corners of a cell are.
    std::uint64_t masks[8] = {block.parts.mask};
    int bit = 1;
    for (int axis = 0; axis < 3; ++axis) {
      if (!group.uses_axis[static_cast<std::size_t>(axis)]) continue;
      for (int c = 0; c < bit; ++c) {
        masks[c + bit] = carried(masks[c], axis);
        masks[c] |= shifted(masks[c], axis);
      }
      bit *= 2;
    }
    for (int c = 0; c < num_corners; ++c) {
      if (masks[c] != 0) vertices.add(group.corner(block.key, c), masks[c]);
    }
  }

  check_interrupt();
  const std::int64_t num_vertices = vertices.number(first_row, num_threads);
  parallel_blocks(count, 1 << 12, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::uint64_t block_key = kEmptyKey;
    const Occupancy* blocks[8] = {};
    for (std::int64_t i = begin; i < end; ++i) {
      const std::uint64_t key = projected[static_cast<std::size_t>(i)];
      if (CellBlocks::block_key(key) != block_key) {
        block_key = CellBlocks::block_key(key);
        for (int c = 0; c < num_corners; ++c) blocks[c] = vertices.find(group.corner(block_key, c));
      }
      for (int c = 0; c < num_corners; ++c) {
        std::uint64_t part = key & 63;
        int block = 0, bit = 0;
        for (int axis = 0; axis < 3; ++axis) {
          if (!group.uses_axis[static_cast<std::size_t>(axis)]) continue;
          if (c >> bit & 1) {
            const bool low = part >> axis & 1, high = part >> (axis + 3) & 1;
            part += static_cast<std::uint64_t>(!low ? 1 : high ? -9 : 7) << axis;
            if (low && high) block |= 1 << bit;
          }
          ++bit;
        }
        cells[i].rows[first_corner + c] = blocks[block]->row(part);
      }
    }
  });
  return num_vertices;
}

// Cells of the next coarser level.
std::vector<std::uint64_t> parents_of(const std::vector<std::uint64_t>& keys) {
  std::vector<std::uint64_t> parents;
  for (const std::uint64_t key : keys) {
    if (parents.empty() || parents.back() != key >> 3) parents.push_back(key >> 3);
  }
  return parents;
}

inline int count_eight_bits(std::uint32_t eight_bits) {
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
  cells_.resize(total);
  parallel_blocks(static_cast<std::int64_t>(total), 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::memset(static_cast<void*>(cells_.data() + begin), 0, sizeof(Cell) * static_cast<std::size_t>(end - begin));
  });

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
        found[0] = parent.first_child + count_eight_bits(parent.child_mask & ((1u << child) - 1));
        prefetch(&cells_[static_cast<std::size_t>(found[0])]);
      }
    }
  }
}

std::vector<std::int32_t> leaf_coordinates(const std::vector<std::uint64_t>& keys) {
  std::vector<std::int32_t> coordinates;
  coordinates.reserve(3 * keys.size());
  for (const std::uint64_t key : keys) {
    for (int axis = 0; axis < 3; ++axis)
      coordinates.push_back(static_cast<std::int32_t>(morton_coordinate(key, axis)) - kAxisBias);
  }
  return coordinates;
}

std::vector<std::uint64_t> leaf_vertex_keys(const VertexTable& table) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  const std::vector<std::uint64_t>& leaf_keys = table.leaf_keys();
  const auto rows_of = [&](std::size_t cell) { return table.cells()[cell].rows; };
  std::int32_t num_rows = 0;
  for (std::size_t cell = 0; cell < leaf_keys.size(); ++cell)
    num_rows = std::max(num_rows, *std::max_element(rows_of(cell), rows_of(cell) + 8) + 1);
  std::vector<std::uint64_t> keys(static_cast<std::size_t>(num_rows));
  for (std::size_t cell = 0; cell < leaf_keys.size(); ++cell) {
    std::uint64_t corners[8] = {leaf_keys[cell]};
    for (int axis = 0; axis < 3; ++axis)
      for (int c = 0; c < 1 << axis; ++c) corners[c + (1 << axis)] = morton_neighbour(corners[c], axis, 1);
    for (int c = 0; c < 8; ++c) keys[static_cast<std::size_t>(rows_of(cell)[c])] = corners[c];
  }
  return keys;
}

LeafVertices leaf_vertices(const VertexTable& table) {
  LeafVertices vertices{leaf_coordinates(leaf_vertex_keys(table)), {}};
  const std::size_t num_cells = table.leaf_keys().size();
  vertices.of_cells.resize(8 * num_cells);
  for (std::size_t i = 0; i < num_cells; ++i) {
    for (std::size_t c = 0; c < 8; ++c) {
      // The table's corners step along x first, those in C order along z.
      vertices.of_cells[8 * i + c] = table.cells()[i].rows[(c & 1) << 2 | (c & 2) | c >> 2];
    }
  }
  return vertices;
}

template void VertexTable::locate(const float*, std::int64_t, std::int32_t*) const;
template void VertexTable::locate(const double*, std::int64_t, std::int32_t*) const;

}  // namespace radarsdf
