#include "returns/growing_sums.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "lattice/cell_blocks.hpp"
#include "lattice/cell_set.hpp"
#include "lattice/morton.hpp"
#include "util/bits.hpp"

namespace radarsdf {
namespace {

constexpr const char* kNeverAdded = "a scan that was never added cannot be taken out";

std::uint64_t block_of(std::uint64_t leaf_key) { return leaf_key >> (3 * kVisibilityLevels); }

// Word of the block's mask and bit in the word that represent a leaf cell.
std::size_t word_of(std::uint64_t leaf_key) { return (leaf_key & (kCellsOfBlock - 1)) >> 6; }
std::uint64_t bit_of(std::uint64_t leaf_key) { return std::uint64_t{1} << (leaf_key & 63); }

// Reserves capacity with geometric growth, as push_back does: exact reserves would copy all elements each time.
template <typename T>
void make_room(std::vector<T>& places, std::size_t more) {
  if (places.size() + more > places.capacity()) places.reserve(std::max(2 * places.capacity(), places.size() + more));
}

}  // namespace

void SumsChange::collect(const RaysOfScan& rays, std::int64_t sign) {
  check_whole_rays(rays.points, rays.directions, rays.ranges_m, rays.count, leaf_size_m_);
  std::vector<std::uint64_t> keys(rays.count);
  cell_keys(rays.points, rays.count, leaf_size_m_, keys.data(), 1);
  const double quanta = 1 / quantum_m_, quanta_of_cell = std::round(leaf_size_m_ / quantum_m_);
  const std::int64_t scan = ++collected_;
  ReachedCubes reached;
  for (std::int64_t i = 0; i < rays.count; ++i) {
    const float *point = rays.points + 3 * i, *direction = rays.directions + 3 * i;
    const std::uint64_t key = keys[i];
    const auto next = static_cast<std::int32_t>(cells_.size());
    if (number_of_cell_.insert(key, next)) cells_.push_back({key, {}, 0, 0});
    Cell& cell = cells_[number_of_cell_.find(key)];
    std::int64_t corner[3];
    for (int axis = 0; axis < 3; ++axis) {
      const auto at = static_cast<std::int32_t>(morton_coordinate(key, axis)) - kAxisBias;
      corner[axis] = at * static_cast<std::int64_t>(quanta_of_cell);
    }
    std::uint64_t terms[kSums];
    sum_terms(point, direction, rays.ranges_m[i], corner, quanta, terms);
    const auto weight = static_cast<std::uint64_t>(sign * rays.weights[i]);
    for (int k = 0; k < kSums; ++k)
      cell.sums[k] = static_cast<std::int64_t>(static_cast<std::uint64_t>(cell.sums[k]) + weight * terms[k]);
    if (cell.last != scan) {
      cell.last = scan;
      cell.scans += sign;
    }
    reached.trace(point, direction, rays.ranges_m[i], leaf_size_m_);
  }
  reached.for_each_block([&](std::uint64_t block_key, std::uint64_t mask) {
    for (; mask != 0; mask &= mask - 1) {
      const std::uint64_t cube = CellBlocks::key_in_block(block_key, lowest_bit(mask));
      const auto number = static_cast<std::int32_t>(visibility_.size());
      if (number_of_cube_.insert(cube, number)) visibility_.push_back({cube, 0});
      visibility_[number_of_cube_.find(cube)].visibility += sign;
    }
  });
}

std::vector<std::uint64_t> SumsChange::block_keys() const {
  std::vector<std::uint64_t> keys;
  keys.reserve(visibility_.size() + cells_.size());
  for (const Visibility& visibility : visibility_) keys.push_back(visibility.key);
  for (const Cell& cell : cells_) keys.push_back(block_of(cell.key));
  std::sort(keys.begin(), keys.end());
  keys.erase(std::unique(keys.begin(), keys.end()), keys.end());
  return keys;
}

ChangedBlocks GrowingSums::apply(const SumsChange& change) {
  std::int64_t new_cells = 0, new_blocks = 0;
  for (const SumsChange::Cell& cell : change.cells_) {
    const std::int32_t place = number_of_cell_.find(cell.key);
    const Cell there = place < 0 ? Cell{} : cells_[place];
    const std::int64_t scans = there.scans + cell.scans;
    if (there.sums[0] + cell.sums[0] < 0 || scans < 0) throw std::invalid_argument(kNeverAdded);
    if (scans > std::numeric_limits<std::uint32_t>::max()) throw std::invalid_argument("too many scans");
    new_cells += place < 0 ? 1 : 0;
    new_blocks += place < 0 && number_of_block_.find(block_of(cell.key)) < 0 ? 1 : 0;
  }
  for (const SumsChange::Visibility& visibility : change.visibility_) {
    const std::int32_t place = number_of_block_.find(visibility.key);
    const std::int64_t there = place < 0 ? 0 : blocks_[place].visibility;
    if (there + visibility.visibility < 0) throw std::invalid_argument(kNeverAdded);
    new_blocks += place < 0 ? 1 : 0;
  }
  // Nothing below this line throws: a change is applied completely or not at all.
  ChangedBlocks changed;
  changed.returns.reserve(change.cells_.size());
  changed.visibility.reserve(change.visibility_.size());
  reserve(new_cells, new_blocks);
  for (const SumsChange::Cell& cell : change.cells_) {
    if (cell.scans == 0 && std::all_of(cell.sums, cell.sums + kSums, [](std::int64_t sum) { return sum == 0; }))
      continue;
    const std::uint64_t block_key = block_of(cell.key);
    changed.returns.push_back(block_key);
    Block& block = block_at(block_key);
    block.mask[word_of(cell.key)] |= bit_of(cell.key);
    Cell& there = value_at(number_of_cell_, cells_, free_cells_, cell.key);
    for (int k = 0; k < kSums; ++k) {
      there.sums[k] = static_cast<std::int64_t>(static_cast<std::uint64_t>(there.sums[k]) +
                                                static_cast<std::uint64_t>(cell.sums[k]));
    }
    there.scans = static_cast<std::uint32_t>(there.scans + cell.scans);
    if (there.sums[0] == 0) drop_cell(cell.key, block);
  }
  for (const SumsChange::Visibility& visibility : change.visibility_) {
    if (visibility.visibility == 0) continue;
    Block& block = block_at(visibility.key);
    block.visibility = static_cast<std::uint32_t>(block.visibility + visibility.visibility);
    changed.visibility.push_back(visibility.key);
  }
  for (std::vector<std::uint64_t>* keys : {&changed.returns, &changed.visibility}) {
    std::sort(keys->begin(), keys->end());
    keys->erase(std::unique(keys->begin(), keys->end()), keys->end());
    for (const std::uint64_t key : *keys) drop_if_empty(key);
  }
  return changed;
}

std::int64_t GrowingSums::num_bytes() const {
  const auto slots = number_of_cell_.slots().size() + number_of_block_.slots().size();
  return static_cast<std::int64_t>(sizeof(Cell) * cells_.capacity() + sizeof(Block) * blocks_.capacity() +
                                   sizeof(Slot) * slots + 4 * (free_cells_.capacity() + free_blocks_.capacity()));
}

std::vector<std::uint64_t> GrowingSums::block_keys() const {
  std::vector<std::uint64_t> keys;
  keys.reserve(number_of_block_.size());
  for (const Slot& slot : number_of_block_.slots()) {
    if (slot.key != kEmptyKey) keys.push_back(slot.key);
  }
  std::sort(keys.begin(), keys.end());
  return keys;
}

SumsOfCells GrowingSums::sums_of(const std::uint64_t* block_keys, std::int64_t count) const {
  SumsOfCells found;
  for (std::int64_t i = 0; i < count; ++i) {
    const std::int32_t place = number_of_block_.find(block_keys[i]);
    if (place < 0) continue;
    for_each_cell(block_keys[i], blocks_[place], [&](std::uint64_t key) {
      const Cell& cell = cells_[number_of_cell_.find(key)];
      found.keys.push_back(key);
      found.sums.insert(found.sums.end(), cell.sums, cell.sums + kSums);
      found.scans.push_back(cell.scans);
    });
  }
  return found;
}

VisibilityOfBlocks GrowingSums::visibility_of(const std::uint64_t* block_keys, std::int64_t count) const {
  VisibilityOfBlocks found;
  for (std::int64_t i = 0; i < count; ++i) {
    const std::int32_t place = number_of_block_.find(block_keys[i]);
    if (place < 0) continue;
    found.keys.push_back(block_keys[i]);
    found.visibility.push_back(blocks_[place].visibility);
  }
  return found;
}

void GrowingSums::insert(const SumsOfCells& cells, const VisibilityOfBlocks& visibility) {
  const auto there_already = [](const FlatMap& map, const std::vector<std::uint64_t>& keys) {
    return std::any_of(keys.begin(), keys.end(), [&](std::uint64_t key) { return map.find(key) >= 0; });
  };
  if (there_already(number_of_cell_, cells.keys) || there_already(number_of_block_, visibility.keys)) {
    throw std::invalid_argument("there are sums of these cells already");
  }
  auto blocks = static_cast<std::int64_t>(visibility.keys.size());
  for (std::size_t i = 0; i < cells.keys.size(); ++i) {
    blocks += i == 0 || block_of(cells.keys[i]) != block_of(cells.keys[i - 1]) ? 1 : 0;
  }
  reserve(static_cast<std::int64_t>(cells.keys.size()), blocks);
  for (std::size_t i = 0; i < cells.keys.size(); ++i) {
    const std::uint64_t key = cells.keys[i];
    Cell& cell = value_at(number_of_cell_, cells_, free_cells_, key);
    std::copy_n(cells.sums.data() + kSums * i, kSums, cell.sums);
    cell.scans = cells.scans[i];
    block_at(block_of(key)).mask[word_of(key)] |= bit_of(key);
  }
  for (std::size_t i = 0; i < visibility.keys.size(); ++i)
    block_at(visibility.keys[i]).visibility = visibility.visibility[i];
}

void GrowingSums::erase(const std::uint64_t* block_keys, std::int64_t count) {
  for (std::int64_t i = 0; i < count; ++i) {
    const std::int32_t place = number_of_block_.find(block_keys[i]);
    if (place < 0) continue;
    Block& block = blocks_[place];
    for_each_cell(block_keys[i], Block{block}, [&](std::uint64_t key) { drop_cell(key, block); });
    block.visibility = 0;
    drop_if_empty(block_keys[i]);
  }
}

bool GrowingSums::Block::is_empty() const {
  return visibility == 0 && std::all_of(mask.begin(), mask.end(), [](std::uint64_t word) { return word == 0; });
}

template <typename Visit>
void GrowingSums::for_each_cell(std::uint64_t block_key, const Block& block, const Visit& visit) const {
  for (std::size_t word = 0; word < block.mask.size(); ++word) {
    for (std::uint64_t bits = block.mask[word]; bits != 0; bits &= bits - 1) {
      visit(block_key << (3 * kVisibilityLevels) | word << 6 | static_cast<std::uint64_t>(lowest_bit(bits)));
    }
  }
}

GrowingSums::Block& GrowingSums::block_at(std::uint64_t key) {
  return value_at(number_of_block_, blocks_, free_blocks_, key);
}

void GrowingSums::drop_cell(std::uint64_t key, Block& block) {
  free_cells_.push_back(number_of_cell_.find(key));
  number_of_cell_.erase(key);
  block.mask[word_of(key)] &= ~bit_of(key);
}

void GrowingSums::drop_if_empty(std::uint64_t block_key) {
  const std::int32_t place = number_of_block_.find(block_key);
  if (place < 0 || !blocks_[place].is_empty()) return;
  free_blocks_.push_back(place);
  number_of_block_.erase(block_key);
}

// The free lists have capacity for all indices, so that freeing one needs no allocation.
void GrowingSums::reserve(std::int64_t cells, std::int64_t blocks) {
  const auto more_cells = static_cast<std::size_t>(cells), more_blocks = static_cast<std::size_t>(blocks);
  if (cells_.size() + more_cells > static_cast<std::size_t>(std::numeric_limits<std::int32_t>::max())) {
    throw std::invalid_argument("more than 2^31 - 1 cells");
  }
  number_of_cell_.reserve(number_of_cell_.size() + more_cells + 1);
  number_of_block_.reserve(number_of_block_.size() + more_blocks + 1);
  make_room(cells_, more_cells);
  make_room(blocks_, more_blocks);
  free_cells_.reserve(cells_.capacity());
  free_blocks_.reserve(blocks_.capacity());
}

}  // namespace radarsdf
