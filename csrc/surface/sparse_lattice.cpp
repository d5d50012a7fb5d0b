// A lattice point is packed into a 64-bit key, x, y, z from the top. A step along an axis adds a constant to the key,
// so sorted cells stay sorted when shifted by a step: corners are unions of sorted lists, computed in linear time with
// sequential memory access and without a hash table.
#include "surface/sparse_lattice.hpp"

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>
#include <vector>

#include "util/integers.hpp"
#include "util/large_array.hpp"
#include "util/parallel.hpp"
#include "util/sorting.hpp"

namespace radarsdf {
namespace {

using Keys = UninitialisedVector<uint64_t>;
constexpr int64_t min_block = 1 << 14;  // smaller blocks do not repay a thread

struct KeyFormat {
  std::array<int64_t, 3> lowest{};
  std::array<int, 3> shift{};  ///< position of each axis; 0 for z
  int bits = 0;                ///< bits of a key

  uint64_t step(size_t axis) const { return uint64_t{1} << shift[axis]; }

  uint64_t encode(const int32_t* point) const {
    uint64_t key = 0;
    for (size_t axis = 0; axis < 3; ++axis) key |= static_cast<uint64_t>(point[axis] - lowest[axis]) << shift[axis];
    return key;
  }

  void decode(uint64_t key, int32_t* point) const {
    for (size_t axis = 0; axis < 3; ++axis) {
      point[axis] = static_cast<int32_t>(static_cast<int64_t>(key >> shift[axis]) + lowest[axis]);
      key &= step(axis) - 1;
    }
  }
};

KeyFormat key_format(const int32_t* cells, int64_t num_cells) {
  std::array<int32_t, 3> lowest{cells[0], cells[1], cells[2]}, highest = lowest;
  for (int64_t m = 0; m < num_cells; ++m) {
    for (size_t axis = 0; axis < 3; ++axis) {
      const int32_t coordinate = cells[3 * m + static_cast<int64_t>(axis)];
      lowest[axis] = std::min(lowest[axis], coordinate);
      highest[axis] = std::max(highest[axis], coordinate);
    }
  }
  KeyFormat format;
  for (size_t axis = 3; axis-- > 0;) {
    if (highest[axis] == std::numeric_limits<int32_t>::max()) {
      throw std::invalid_argument("a cell's upper corner is beyond int32");
    }
    format.lowest[axis] = lowest[axis];
    format.shift[axis] = format.bits;
    const int64_t last_corner = int64_t{highest[axis]} + 1 - lowest[axis];
    while (last_corner >> (format.bits - format.shift[axis]) != 0) ++format.bits;
  }
  if (format.bits > 63)
    throw std::invalid_argument("the cells are too far apart: their extents need more than 63 bits");
  return format;
}

// Union of a and b + step, both strictly increasing. Blocks are split at keys of `a`, so they do not overlap.
Keys merge_shifted(const Keys& a, const Keys& b, uint64_t step, int num_threads) {
  const auto size = static_cast<int64_t>(a.size());
  const int64_t num_blocks = std::clamp<int64_t>(size / min_block, 1, resolve_num_threads(num_threads));
  std::vector<Keys> parts(num_blocks);
  parallel_tasks(num_blocks, num_threads, [&](int64_t block) {
    const auto cut = [&](int64_t i) { return a.data() + size * i / num_blocks; };
    const auto cut_b = [&](int64_t i) {
      if (i == 0) return b.data();
      if (i == num_blocks) return b.data() + b.size();
      const uint64_t key = *cut(i);
      return std::lower_bound(b.data(), b.data() + b.size(), key < step ? 0 : key - step);
    };
    const uint64_t *ia = cut(block), *ib = cut_b(block);
    const uint64_t *end_a = cut(block + 1), *end_b = cut_b(block + 1);
    Keys part((end_a - ia) + (end_b - ib));
    uint64_t* out = part.data();
    while (ia != end_a && ib != end_b) {  // branch-free: comparisons of keys are unpredictable
      const uint64_t key_a = *ia, key_b = *ib + step;
      *out++ = std::min(key_a, key_b);
      ia += key_a <= key_b;
      ib += key_b <= key_a;
    }
    out = std::copy(ia, end_a, out);
    out = std::transform(ib, end_b, out, [&](uint64_t key) { return key + step; });
    part.resize(out - part.data());
    parts[block] = std::move(part);
  });
  Keys merged = std::move(parts[0]);
  for (size_t i = 1; i < parts.size(); ++i) merged.insert(merged.end(), parts[i].begin(), parts[i].end());
  return merged;
}

// Each thread sorts a part; the sorted set does not depend on the partition.
Keys sorted_set(const int32_t* cells, int64_t num_cells, const KeyFormat& format, int num_threads) {
  const int64_t num_parts = std::clamp<int64_t>(num_cells / min_block, 1, resolve_num_threads(num_threads));
  std::vector<Keys> parts(num_parts);
  parallel_tasks(num_parts, num_threads, [&](int64_t part) {
    const int64_t begin = num_cells * part / num_parts;
    Keys keys(num_cells * (part + 1) / num_parts - begin);
    for (size_t m = 0; m < keys.size(); ++m) keys[m] = format.encode(cells + 3 * (begin + static_cast<int64_t>(m)));
    radix_sort(keys, 0, format.bits);
    keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
    parts[part] = std::move(keys);
  });
  for (; parts.size() > 1; parts.resize((parts.size() + 1) / 2)) {
    const size_t half = (parts.size() + 1) / 2;
    for (size_t i = half; i < parts.size(); ++i)
      parts[i - half] = merge_shifted(parts[i - half], parts[i], 0, num_threads);
  }
  return std::move(parts[0]);
}

std::unique_ptr<int32_t[]> decode_all(const Keys& keys, const KeyFormat& format, int num_threads) {
  auto points = large_array<int32_t>(3 * static_cast<int64_t>(keys.size()));
  parallel_for(static_cast<int64_t>(keys.size()), min_block, num_threads,
               [&](int64_t i) { format.decode(keys[i], points.get() + 3 * i); });
  return points;
}

}  // namespace

SparseLattice sparse_lattice(const int32_t* cells, int64_t num_cells, int num_threads) {
  if (num_cells == 0) {
    return {0, 0, std::make_unique<int32_t[]>(0), std::make_unique<int32_t[]>(0), std::make_unique<int32_t[]>(0)};
  }
  const KeyFormat format = key_format(cells, num_cells);
  const Keys cell_keys = sorted_set(cells, num_cells, format, num_threads);
  Keys corner_keys = merge_shifted(cell_keys, cell_keys, format.step(2), num_threads);
  for (const size_t axis : {size_t{1}, size_t{0}}) {
    corner_keys = merge_shifted(corner_keys, corner_keys, format.step(axis), num_threads);
  }
  if (corner_keys.size() > static_cast<size_t>(std::numeric_limits<int32_t>::max())) {
    throw std::invalid_argument("there are more corners than int32 cells can refer to");
  }

  SparseLattice lattice;
  lattice.num_cells = static_cast<int64_t>(cell_keys.size());
  lattice.num_corners = static_cast<int64_t>(corner_keys.size());
  lattice.cells = decode_all(cell_keys, format, num_threads);
  lattice.corners = decode_all(corner_keys, format, num_threads);
  lattice.cell_corners = large_array<int32_t>(8 * lattice.num_cells);
  parallel_blocks(lattice.num_cells, min_block, num_threads, [&](int64_t begin, int64_t end) {
    // The next corner along z is the next key. The lower corners of the four columns are found by advancing from the
    // previous cell.
    const std::array<uint64_t, 4> steps{0, format.step(1), format.step(0), format.step(0) + format.step(1)};
    const uint64_t* const keys = corner_keys.data();
    std::array<const uint64_t*, 4> found{};
    for (size_t row = 0; row < 4; ++row) {
      found[row] = std::lower_bound(keys, keys + corner_keys.size(), cell_keys[begin] + steps[row]);
    }
    for (int64_t m = begin; m < end; ++m) {
      for (size_t row = 0; row < 4; ++row) {
        const uint64_t key = cell_keys[m] + steps[row];
        while (*found[row] < key) ++found[row];
        int32_t* corners = lattice.cell_corners.get() + 8 * m + 2 * static_cast<int64_t>(row);
        corners[0] = static_cast<int32_t>(found[row] - keys);
        corners[1] = corners[0] + 1;
      }
    }
  });
  return lattice;
}

}  // namespace radarsdf
