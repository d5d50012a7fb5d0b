// Flat open-addressing map from 64-bit keys to 32-bit values: power-of-two capacity, linear probing, load factor at
// most one half. Exact: full keys are compared, so two keys never share a value.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "util/large_array.hpp"

namespace radarsdf {

constexpr std::uint64_t kEmptyKey = ~std::uint64_t{0};  // no lattice key uses the top bit

// Multiplicative (Fibonacci) hashing: the high bits of key * 2^64/phi depend on every bit of the key.
inline std::uint64_t hash_key(std::uint64_t key) { return key * 0x9e3779b97f4a7c15; }

struct Slot {
  std::uint64_t key = kEmptyKey;
  std::int32_t value = -1;
};

// Look-up without the container, so that kernels of different instruction sets share no library code.
struct FlatMapView {
  const Slot* slots;
  std::uint64_t mask;  // capacity - 1
  int shift;           // 64 - log2(capacity)

  std::uint64_t home(std::uint64_t key) const { return hash_key(key) >> shift; }

  std::int32_t find(std::uint64_t key) const {
    for (std::uint64_t i = home(key);; i = (i + 1) & mask) {
      if (slots[i].key == key) return slots[i].value;
      if (slots[i].key == kEmptyKey) return -1;
    }
  }
};

class FlatMap {
 public:
  explicit FlatMap(std::size_t expected_size = 0) { reset(expected_size); }

  std::size_t size() const { return size_; }
  FlatMapView view() const { return {slots_.data(), slots_.size() - 1, shift_}; }
  std::int32_t find(std::uint64_t key) const { return view().find(key); }
  const LargeVector<Slot>& slots() const { return slots_; }

  // Reserves capacity: inserting this many keys then needs no allocation.
  void reserve(std::size_t size) {
    while (2 * size > slots_.size()) grow();
  }

  // Erases a key by backward shift, without a tombstone. Returns false if it is not present.
  bool erase(std::uint64_t key) {
    const FlatMapView table = view();
    std::uint64_t gap = table.home(key);
    while (slots_[gap].key != key) {
      if (slots_[gap].key == kEmptyKey) return false;
      gap = (gap + 1) & table.mask;
    }
    for (std::uint64_t i = (gap + 1) & table.mask; slots_[i].key != kEmptyKey; i = (i + 1) & table.mask) {
      const std::uint64_t from_home = (i - table.home(slots_[i].key)) & table.mask, from_gap = (i - gap) & table.mask;
      if (from_home < from_gap) continue;
      slots_[gap] = slots_[i];
      gap = i;
    }
    slots_[gap] = Slot{};
    --size_;
    return true;
  }

  // Removes all keys; keeps the memory.
  void clear() {
    std::fill(slots_.begin(), slots_.end(), Slot{});
    size_ = 0;
  }

  // Returns false, and keeps the old value, if the key is present.
  bool insert(std::uint64_t key, std::int32_t value) {
    const std::size_t before = size_;
    find_or_insert(key, value);
    return size_ > before;
  }

  // The value of a key, which is inserted with this value unless it is present.
  std::int32_t find_or_insert(std::uint64_t key, std::int32_t value) {
    if (2 * (size_ + 1) > slots_.size()) grow();
    const FlatMapView table = view();
    std::uint64_t i = table.home(key);
    while (slots_[i].key != key && slots_[i].key != kEmptyKey) i = (i + 1) & table.mask;
    if (slots_[i].key == kEmptyKey) {
      slots_[i] = {key, value};
      ++size_;
    }
    return slots_[i].value;
  }

 private:
  void reset(std::size_t expected_size) {
    int log2_capacity = 4;
    while ((std::size_t{1} << log2_capacity) < 2 * expected_size) ++log2_capacity;
    slots_.assign(std::size_t{1} << log2_capacity, Slot{});
    shift_ = 64 - log2_capacity;
    size_ = 0;
  }

  void grow() {
    const LargeVector<Slot> old = slots_;  // copied first: strong exception guarantee
    reset(slots_.size());
    for (const Slot& slot : old) {
      if (slot.key != kEmptyKey) insert(slot.key, slot.value);
    }
  }

  LargeVector<Slot> slots_;
  int shift_ = 60;
  std::size_t size_ = 0;
};

// The value of a key in a vector with these free places. A missing key is inserted, with an empty value.
template <typename T>
T& value_at(FlatMap& places, std::vector<T>& values, std::vector<std::int32_t>& free, std::uint64_t key) {
  std::int32_t place = places.find(key);
  if (place < 0) {
    if (free.empty()) {
      free.push_back(static_cast<std::int32_t>(values.size()));
      values.emplace_back();
    }
    place = free.back();
    free.pop_back();
    values[place] = T{};
    places.insert(key, place);
  }
  return values[place];
}

}  // namespace radarsdf
