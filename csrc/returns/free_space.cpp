#include "returns/free_space.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <stdexcept>
#include <utility>

#include "lattice/cell_walk.hpp"
#include "lattice/flat_map.hpp"
#include "util/parallel.hpp"

namespace radarsdf {
namespace {

// A ray is traversed towards the sensor until it has crossed this many consecutive cells already marked by its scan.
constexpr int kPassedCells = 8;
constexpr int kBlockBits = 3 * kFreeSpaceLevels;
using Bits = std::array<std::uint64_t, kFreeSpaceWords>;  // one bit per leaf cell of a block
using Planes = std::array<std::uint64_t, kFreeSpaceStride>;

// Blocks by key, in order of insertion.
template <typename Block>
class Blocks {
 public:
  Block& at(std::uint64_t key) {
    const auto next = static_cast<std::int32_t>(blocks.size()), found = rows_.find_or_insert(key, next);
    if (found == next) {
      keys.push_back(key);
      blocks.push_back({});
    }
    return blocks[found];
  }
  void clear() {
    rows_.clear();
    keys.clear();
    blocks.clear();
  }

  std::vector<std::uint64_t> keys;
  std::vector<Block> blocks;

 private:
  FlatMap rows_;
};

// Leaf cells of a block observed by one scan.
struct Seen {
  Bits passed, returns;
};

// Adds one scan to the bit-sliced counters of a block, 64 leaf cells at a time.
void add_scan(const Seen& seen, Planes& block) {
  for (std::size_t word = 0; word < kFreeSpaceWords; ++word) {
    std::uint64_t &ones = block[word], &twos = block[kFreeSpaceWords + word],
                  &fours = block[2 * kFreeSpaceWords + word];
    const std::uint64_t more = seen.passed[word] & ~(ones & twos & fours);  // saturates at 7
    const std::uint64_t carry = ones & more, carry2 = twos & carry;
    ones ^= more;
    twos ^= carry;
    fours ^= carry2;
    block[kCountPlanes * kFreeSpaceWords + word] |= seen.returns[word];
  }
}

// Adds the counts of other scans.
void add_counts(const std::uint64_t* other, std::uint64_t* block) {
  for (std::size_t word = 0; word < kFreeSpaceWords; ++word) {
    std::uint64_t carry = 0;
    for (std::size_t plane = 0; plane < kCountPlanes; ++plane) {
      const std::uint64_t a = block[plane * kFreeSpaceWords + word], b = other[plane * kFreeSpaceWords + word];
      block[plane * kFreeSpaceWords + word] = a ^ b ^ carry;
      carry = (a & b) | (a & carry) | (b & carry);
    }
    for (std::size_t plane = 0; plane < kCountPlanes; ++plane) block[plane * kFreeSpaceWords + word] |= carry;
    block[kCountPlanes * kFreeSpaceWords + word] |= other[kCountPlanes * kFreeSpaceWords + word];
  }
}

struct Rays {
  const float *points, *directions, *ranges_m, *passed_m;
  const std::int32_t* scans;
  std::int64_t count;
};

void check(const Rays& rays, double leaf_size_m) {
  if (!std::is_sorted(rays.scans, rays.scans + rays.count) || (rays.count > 0 && rays.scans[0] < 0)) {
    throw std::invalid_argument("scans must be ascending numbers of at least 0");
  }
  const double limit_m = (kAxisBias - (1 << kFreeSpaceLevels)) * leaf_size_m;
  bool inside = leaf_size_m > 0;
  for (std::int64_t i = 0; i < 3 * rays.count; ++i) {  // NaN fails the comparison too
    const double range_m = rays.ranges_m[i / 3], sensor_m = rays.points[i] - range_m * double{rays.directions[i]};
    inside = inside && std::abs(double{rays.points[i]}) < limit_m && std::abs(sensor_m) < limit_m && range_m >= 0 &&
             rays.passed_m[i / 3] <= range_m;
  }
  if (!inside) throw std::invalid_argument("rays must be finite and within a million cells of the origin");
}

class Walker {
 public:
  Walker(const Rays& rays, double leaf_size_m, const std::int32_t* lower, const std::int32_t* upper)
      : rays_(rays), leaf_size_m_(leaf_size_m) {
    for (int axis = 0; axis < 3; ++axis) {
      first_[axis] = std::int64_t{lower[axis]} >> kFreeSpaceLevels;
      last_[axis] = (std::int64_t{upper[axis]} - 1) >> kFreeSpaceLevels;
    }
  }

  void walk(std::int64_t begin, std::int64_t end, Blocks<Planes>& counts) const {
    Blocks<Seen> scan;
    const auto finish = [&] {
      for (std::size_t i = 0; i < scan.keys.size(); ++i) add_scan(scan.blocks[i], counts.at(scan.keys[i]));
      scan.clear();
    };
    for (std::int64_t i = begin; i < end; ++i) {
      if (i % (1 << 10) == 0) check_interrupt();
      if (i > begin && rays_.scans[i] != rays_.scans[i - 1]) finish();
      const float* direction = rays_.directions + 3 * i;
      const float backwards[3] = {-direction[0], -direction[1], -direction[2]};
      const double range_m = rays_.ranges_m[i], behind_m = range_m - double{rays_.passed_m[i]};
      mark(scan, CellWalk(rays_.points + 3 * i, backwards, 0, 0, leaf_size_m_), &Seen::returns);
      if (behind_m <= range_m) {
        mark(scan, CellWalk(rays_.points + 3 * i, backwards, behind_m, range_m, leaf_size_m_), &Seen::passed);
      }
    }
    finish();
  }

 private:
  // Consecutive cells of a ray mostly share a block, so only a change of block needs a look-up.
  void mark(Blocks<Seen>& scan, CellWalk cell, Bits Seen::* which) const {
    std::uint64_t block_key = kEmptyKey;
    Bits* bits = nullptr;
    for (int on_end = 0; cell.inside() && on_end < kPassedCells; cell.next()) {
      const std::uint64_t key = cell.key();
      if (key >> kBlockBits != block_key) {
        block_key = key >> kBlockBits;
        bits = wanted(cell) ? &(scan.at(block_key).*which) : nullptr;
      }
      if (bits == nullptr) continue;
      std::uint64_t& word = (*bits)[key >> 6 & 7];
      const std::uint64_t bit = std::uint64_t{1} << (key & 63);
      on_end = (word & bit) != 0 ? on_end + 1 : 0;
      word |= bit;
    }
  }

  bool wanted(const CellWalk& cell) const {
    bool inside = true;
    for (int axis = 0; axis < 3; ++axis) {
      const std::int64_t block = cell.coordinate(axis) >> kFreeSpaceLevels;
      inside = inside && first_[axis] <= block && block <= last_[axis];
    }
    return inside;
  }

  Rays rays_;
  double leaf_size_m_;
  std::int64_t first_[3], last_[3];
};

// First ray of a part; parts hold whole scans.
std::int64_t begin_of(const Rays& rays, std::int64_t part, std::int64_t parts) {
  const std::int64_t near = rays.count * part / parts;
  if (near == 0 || near == rays.count) return near;
  return std::lower_bound(rays.scans, rays.scans + rays.count, rays.scans[near]) - rays.scans;
}

}  // namespace

FreeSpace find_free_space(const float* points, const float* directions, const float* ranges_m, const float* passed_m,
                          const std::int32_t* scans, std::int64_t count, double leaf_size_m, const std::int32_t* lower,
                          const std::int32_t* upper, int num_threads) {
  const Rays rays{points, directions, ranges_m, passed_m, scans, count};
  check(rays, leaf_size_m);
  const Walker walker(rays, leaf_size_m, lower, upper);
  const std::int64_t parts = count > (1 << 12) ? resolve_num_threads(num_threads) : 1;
  std::vector<Blocks<Planes>> of_parts(parts);
  parallel_tasks(parts, num_threads, [&](std::int64_t part) {
    walker.walk(begin_of(rays, part, parts), begin_of(rays, part + 1, parts), of_parts[part]);
  });
  Blocks<Planes>& all = of_parts[0];
  for (std::size_t part = 1; part < of_parts.size(); ++part) {
    for (std::size_t i = 0; i < of_parts[part].keys.size(); ++i) {
      add_counts(of_parts[part].blocks[i].data(), all.at(of_parts[part].keys[i]).data());
    }
    of_parts[part].clear();
  }
  std::vector<std::size_t> order(all.keys.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return all.keys[a] < all.keys[b]; });
  FreeSpace found;
  found.keys.reserve(order.size());
  found.planes.reserve(order.size() * kFreeSpaceStride);
  for (const std::size_t i : order) {
    found.keys.push_back(all.keys[i]);
    found.planes.insert(found.planes.end(), all.blocks[i].begin(), all.blocks[i].end());
  }
  return found;
}

}  // namespace radarsdf
