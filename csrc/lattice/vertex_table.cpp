#include "lattice/vertex_table.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "lattice/cell_blocks.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"
#include "util/parallel.hpp"
#include "util/prefetch.hpp"
#include "util/sorting.hpp"

namespace radarsdf {
namespace {

// Bits of a key that encode the coordinate along an axis.
constexpr std::uint64_t key_bits(int axis) { return std::uint64_t{0x1249249249249249} << axis; }

// A group of corners of a cell with features: on one plane of the tri-quadtree (keys are zero along the normal of the
// plane, so the cells of a column share vertices), or in space.
struct VertexGroup {
  std::array<bool, 3> uses_axis;
  int num_corners;

  std::uint64_t project(std::uint64_t cell_key) const {
    std::uint64_t key = 0;
    for (int axis = 0; axis < 3; ++axis) {
      if (uses_axis[axis]) key |= cell_key & key_bits(axis);
    }
    return key;
  }

  // Corners of a projected cell: bit i of a corner's number is a step along the i-th used axis.
  void corners(std::uint64_t projected_key, std::uint64_t* keys) const {
    keys[0] = projected_key;
    int count = 1;
    for (int axis = 0; axis < 3; ++axis) {
      if (!uses_axis[axis]) continue;
      for (int c = 0; c < count; ++c) keys[c + count] = morton_neighbour(keys[c], axis, 1);
      count *= 2;
    }
  }
};

const std::vector<VertexGroup>& vertex_groups(Encoding encoding) {
  static const std::vector<VertexGroup> planes = {
      {{true, true, false}, 4}, {{true, false, true}, 4}, {{false, true, true}, 4}};
  static const std::vector<VertexGroup> space = {{{true, true, true}, 8}};
  return encoding == Encoding::kTriQuadtree ? planes : space;
}

// Bit masks of cells or vertices by block of 4 x 4 x 4, so that set operations on a block are a few instructions on one
// word.
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
    blocks_[found].parts.mask |= mask;
  }

  // Sorts the blocks, assigns rows to their occupied parts from `first_row` on in the order of keys, and returns the
  // number of rows.
  std::int64_t number(std::int64_t first_row) {
    std::sort(blocks_.begin(), blocks_.end(), [](const VertexBlock& a, const VertexBlock& b) { return a.key < b.key; });
    numbers_.clear();
    std::int64_t row = first_row;
    for (std::size_t i = 0; i < blocks_.size(); ++i) {
      numbers_.insert(blocks_[i].key, static_cast<std::int32_t>(i));
      blocks_[i].parts.first = static_cast<std::int32_t>(row);
      row += count_bits(blocks_[i].parts.mask);
      if (row > std::numeric_limits<std::int32_t>::max())
        throw std::invalid_argument("the map needs more than 2^31 vertices: use larger cells");
    }
    return row - first_row;
  }

  const Occupancy* find(std::uint64_t block_key) const {
    const std::int32_t found = numbers_.find(block_key);
    return found >= 0 ? &blocks_[found].parts : nullptr;
  }

  std::vector<VertexBlock>& blocks() { return blocks_; }

 private:
  FlatMap numbers_;
  std::vector<VertexBlock> blocks_;
};

// Cube of 5 x 5 x 5 vertices of a block of cells, x slowest: positions of the parts of a block, and masks of the parts
// in the cube for the block and the next seven.
struct Corners {
  std::uint8_t places[64] = {};
  std::uint64_t masks[8] = {};

  constexpr Corners() {
    for (int part = 0; part < 64; ++part) {
      int place = 0, inside = 7;
      for (int axis = 0; axis < 3; ++axis) {
        const int at = (part >> axis & 1) | (part >> (axis + 2) & 2);
        place += at * kStrides[axis];
        if (at > 0) inside &= ~(1 << axis);
      }
      places[part] = static_cast<std::uint8_t>(place);
      for (int block = 0; block < 8; ++block) {
        if ((block & ~inside) == 0) masks[block] |= std::uint64_t{1} << part;
      }
    }
  }

  static constexpr int kStrides[3] = {25, 5, 1};
};
constexpr Corners kCorners;

// Faces of cells on the plane of a group. In space, these are the cells.
BlockMasks faces_of(const VertexGroup& group, const std::vector<std::uint64_t>& keys) {
  const auto block_of = [&](std::size_t i) { return CellBlocks::block_key(group.project(keys[i])); };
  BlockMasks faces(0);
  for (std::size_t i = 0; i < keys.size();) {
    const std::uint64_t block_key = block_of(i);
    std::uint64_t mask = 0;
    for (; i < keys.size() && block_of(i) == block_key; ++i) mask |= std::uint64_t{1} << (group.project(keys[i]) & 63);
    faces.add(block_key, mask);
  }
  return faces;
}

// Assigns a row to every vertex of the numbered faces, from next_row on, and writes the rows of their corners to `rows`
// (faces, corners), indexed by their numbers. Returns the vertices.
std::vector<VertexBlock> assign_rows(const VertexGroup& group, const std::vector<VertexBlock>& faces,
                                     std::int32_t* rows, std::int64_t& next_row, int num_threads) {
  const int num_corners = group.num_corners;
  int axes[8] = {};  // by corner: bit `axis` is a step along the axis
  BlockMasks vertices(2 * faces.size());
  for (const VertexBlock& block : faces) {
    // Masks of the block and of the next ones, numbered like the corners of a cell.
    std::uint64_t masks[8] = {block.parts.mask}, block_keys[8];
    group.corners(block.key, block_keys);
    int bit = 1;
    for (int axis = 0; axis < 3; ++axis) {
      if (!group.uses_axis[axis]) continue;
      for (int c = 0; c < bit; ++c) {
        axes[c + bit] = axes[c] | 1 << axis;
        masks[c + bit] = carried(masks[c], axis);
        masks[c] |= shifted(masks[c], axis);
      }
      bit *= 2;
    }
    for (int c = 0; c < num_corners; ++c) vertices.add(block_keys[c], masks[c]);
  }

  check_interrupt();
  next_row += vertices.number(next_row);
  int steps[8] = {};
  for (int c = 0; c < num_corners; ++c)
    for (int axis = 0; axis < 3; ++axis) steps[c] += (axes[c] >> axis & 1) * Corners::kStrides[axis];
  const auto num_blocks = static_cast<std::int64_t>(faces.size());
  parallel_blocks(num_blocks, 1 << 7, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::int32_t cube[5 * 5 * 5] = {};
    for (auto face = faces.begin() + begin; face != faces.begin() + end; ++face) {
      std::uint64_t block_keys[8];
      group.corners(face->key, block_keys);
      for (int c = 0; c < num_corners; ++c) {
        const Occupancy* block = vertices.find(block_keys[c]);
        if (block == nullptr) continue;
        for (std::uint64_t bits = block->mask & kCorners.masks[axes[c]]; bits != 0; bits &= bits - 1) {
          const int part = lowest_bit(bits);
          cube[kCorners.places[part] + 4 * steps[c]] = block->row(static_cast<std::uint64_t>(part));
        }
      }
      std::int32_t* to = rows + std::int64_t{face->parts.first} * num_corners;
      for (std::uint64_t bits = face->parts.mask; bits != 0; bits &= bits - 1) {
        const std::int32_t* first = cube + kCorners.places[lowest_bit(bits)];
        for (int c = 0; c < num_corners; ++c) *to++ = first[steps[c]];
      }
    }
  });
  return std::move(vertices.blocks());
}

// Writes the numbers of the faces of cells on one of three planes.
void write_faces(const VertexGroup& group, const BlockMasks& faces, const std::vector<std::uint64_t>& keys,
                 std::int32_t* numbers, int num_threads) {
  const auto count = static_cast<std::int64_t>(keys.size());
  parallel_blocks(count, 1 << 14, num_threads, [&](std::int64_t begin, std::int64_t end) {
    std::uint64_t block_key = kEmptyKey;
    const Occupancy* block = nullptr;
    for (std::int64_t i = begin; i < end; ++i) {
      const std::uint64_t key = group.project(keys[i]);
      if (CellBlocks::block_key(key) != block_key) {
        block_key = CellBlocks::block_key(key);
        block = faces.find(block_key);
      }
      numbers[3 * i] = block->row(key);
    }
  });
}

inline int count_eight_bits(std::uint32_t eight_bits) {
  std::uint32_t v = eight_bits - ((eight_bits >> 1) & 0x55u);
  v = (v & 0x33u) + ((v >> 2) & 0x33u);
  return static_cast<int>((v + (v >> 4)) & 0x0fu);
}

}  // namespace

VertexTable::VertexTable(std::vector<std::uint64_t> leaf_keys, double leaf_size_m, int num_levels, Encoding encoding,
                         int num_threads)
    : leaf_keys_(std::move(leaf_keys)),
      leaf_size_m_(leaf_size_m),
      num_levels_(num_levels),
      encoding_(encoding),
      leaves_(leaf_keys_.data(), static_cast<std::int64_t>(leaf_keys_.size())) {
  if (!(leaf_size_m > 0) || !std::isfinite(leaf_size_m))
    throw std::invalid_argument("leaf_size_m must be positive and finite");
  if (num_levels < 1 || num_levels > kMaxLevels) throw std::invalid_argument("num_levels must be 1 to 12");
  for (std::size_t i = 0; i < leaf_keys_.size(); ++i) {
    for (int axis = 0; axis < 3; ++axis) {
      // The far vertex of a cell must fit its key at every level.
      const std::uint64_t last = key_bits(axis) >> (3 * num_levels) << (3 * num_levels);
      if (leaf_keys_[i] >> 63 || (leaf_keys_[i] & last) == last)
        throw std::invalid_argument("leaf_keys holds a cell outside the lattice");
    }
  }

  const std::vector<VertexGroup>& groups = vertex_groups(encoding);
  const std::size_t num_groups = groups.size(), corners = groups[0].num_corners;
  // Mostly enough for all levels: a growing array would be copied.
  if (num_groups > 1) faces_.reserve(num_groups * 2 * leaf_keys_.size());
  std::vector<std::uint64_t> coarser;
  std::size_t first = 0;
  for (int level = 0; level < num_levels; ++level) {
    const std::vector<std::uint64_t>& keys = level == 0 ? leaf_keys_ : coarser;
    const std::size_t count = keys.size();
    if (first + count > static_cast<std::size_t>(std::numeric_limits<std::int32_t>::max()))
      throw std::invalid_argument("the map needs more than 2^31 cells: use larger cells");
    if (num_groups > 1) faces_.resize(num_groups * (first + count));
    for (std::size_t g = 0; g < num_groups; ++g) {
      BlockMasks faces = faces_of(groups[g], keys);
      check_interrupt();
      const std::int64_t num_faces = faces.number(static_cast<std::int64_t>(rows_.size() / corners));
      rows_.resize(rows_.size() + corners * num_faces);
      std::vector<VertexBlock> blocks = assign_rows(groups[g], faces.blocks(), rows_.data(), num_rows_, num_threads);
      if (num_groups > 1) {
        write_faces(groups[g], faces, keys, &faces_[num_groups * first + g], num_threads);
      } else if (level == 0) {
        leaf_vertex_blocks_ = std::move(blocks);
      }
    }
    if (level + 1 == num_levels) break;
    std::vector<std::uint64_t> parents;
    for (std::size_t i = 0; i < count; ++i) {
      if (parents.empty() || parents.back() != keys[i] >> 3) {
        parents.push_back(keys[i] >> 3);
        children_.push_back({static_cast<std::int32_t>(first + i), 0});
      }
      children_.back().mask |= 1u << (keys[i] & 7);
    }
    coarser = std::move(parents);
    first += count;
  }
  if (num_levels > 1) roots_ = CellBlocks(coarser.data(), static_cast<std::int64_t>(coarser.size()));
}

template <typename T>
void VertexTable::locate(const T* points, std::int64_t count, std::int32_t* cells) const {
  NearbyRows roots(num_levels_ == 1 ? leaves_ : roots_);
  const std::int32_t first_root = num_levels_ == 1 ? 0 : static_cast<std::int32_t>(num_cells() - roots_.size());
  const T inverse = static_cast<T>(1.0 / leaf_size_m_), limit = static_cast<T>(kAxisBias);
  const int coarsest = num_levels_ - 1;
  const std::int64_t num_leaves = leaves_.size();
  const auto prefetch_cell = [&](std::int32_t cell, int level) {
    if (level > 0) prefetch(children_.data() + (cell - num_leaves));
    prefetch(faces_.empty() ? rows_of(cell) : faces_.data() + 3 * std::int64_t{cell});
  };
  // In stages over blocks that fit the L1 cache, so that the cache misses of many points overlap.
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
    }
    for (std::int64_t i = 0; i < size; ++i) {
      const std::int32_t row = root_key[i] == kEmptyKey ? -1 : roots.row(root_key[i]);
      const std::int32_t root = row >= 0 ? first_root + row : -1;
      cells[(first + i) * num_levels_ + coarsest] = root;
      if (root >= 0) prefetch_cell(root, coarsest);
    }
    for (int level = coarsest; level-- > 0;) {
      for (std::int64_t i = 0; i < size; ++i) {
        std::int32_t* found = cells + (first + i) * num_levels_ + level;
        found[0] = -1;
        if (found[1] < 0) continue;
        const Children& parent = children_[found[1] - num_leaves];
        const auto bit = [&](int axis) { return leaf[i][axis] >> level & 1u; };
        const std::uint32_t child = bit(0) | bit(1) << 1 | bit(2) << 2;
        if (!(parent.mask >> child & 1u)) continue;
        found[0] = parent.first + count_eight_bits(parent.mask & ((1u << child) - 1));
        prefetch_cell(found[0], level);
      }
    }
  }
}

std::vector<std::int32_t> leaf_coordinates(const std::vector<std::uint64_t>& keys) {
  std::vector<std::int32_t> coordinates;
  coordinates.reserve(3 * keys.size());
  for (const std::uint64_t key : keys) {
    for (int axis = 0; axis < 3; ++axis) coordinates.push_back(lattice_coordinate(key, axis));
  }
  return coordinates;
}

LeafVertices leaf_vertices(const VertexTable& table, int num_threads) {
  if (table.encoding() != Encoding::kOctree) throw std::invalid_argument("only an octree has vertices in space");
  const std::vector<VertexBlock>& blocks = table.leaf_vertex_blocks();
  const auto num_cells = static_cast<std::int64_t>(table.leaf_keys().size());
  const std::int64_t num_vertices =
      blocks.empty() ? 0 : blocks.back().parts.first + count_bits(blocks.back().parts.mask);
  LeafVertices vertices{std::vector<std::int32_t>(3 * num_vertices), std::vector<std::int32_t>(8 * num_cells)};
  const auto num_blocks = static_cast<std::int64_t>(blocks.size());
  parallel_blocks(num_blocks, 1 << 9, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (auto block = blocks.begin() + begin; block != blocks.begin() + end; ++block) {
      std::int32_t* to = vertices.coordinates.data() + 3 * std::int64_t{block->parts.first};
      for (std::uint64_t bits = block->parts.mask; bits != 0; bits &= bits - 1) {
        const std::uint64_t key = CellBlocks::key_in_block(block->key, lowest_bit(bits));
        for (int axis = 0; axis < 3; ++axis) *to++ = lattice_coordinate(key, axis);
      }
    }
  });
  parallel_for(num_cells, 1 << 14, num_threads, [&](std::int64_t i) {
    const std::int32_t* rows = table.rows_of(i);
    std::int32_t* to = vertices.of_cells.data() + 8 * i;
    // x is the fastest axis of the table's corners, z that of corners in C order.
    for (int c = 0; c < 8; ++c) to[c] = rows[(c & 1) << 2 | (c & 2) | c >> 2];
  });
  return vertices;
}

template void VertexTable::locate(const float*, std::int64_t, std::int32_t*) const;
template void VertexTable::locate(const double*, std::int64_t, std::int32_t*) const;

}  // namespace radarsdf
