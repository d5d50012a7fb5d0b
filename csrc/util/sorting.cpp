#include "util/sorting.hpp"

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>

#include "util/parallel.hpp"

namespace radarsdf {
namespace {

constexpr int kDigitBits = 11;  // 2048 counters fit the L1 cache
constexpr int kDigits = (64 + kDigitBits - 1) / kDigitBits;
constexpr std::uint64_t kDigitMask = (1 << kDigitBits) - 1;

struct Entry {
  std::uint32_t low, high;  // halves of the key: 12 bytes per entry instead of 16
  std::int32_t position;

  std::uint64_t digit(int number) const {
    return ((std::uint64_t{high} << 32 | low) >> (number * kDigitBits)) & kDigitMask;
  }
};

}  // namespace

void parallel_sort(std::vector<std::uint64_t>& keys, int num_threads) {
  const auto size = static_cast<std::int64_t>(keys.size());
  std::int64_t blocks = 1;
  const std::int64_t threads = resolve_num_threads(num_threads);
  // Large inputs have more blocks than threads: an interrupt is handled only at the end of a block.
  while (size / blocks > (blocks * 2 <= threads ? 1 << 15 : 1 << 22)) blocks *= 2;
  const auto at = [&](std::int64_t i) { return keys.begin() + size * i / blocks; };
  parallel_tasks(blocks, num_threads, [&](std::int64_t i) { std::sort(at(i), at(i + 1)); });
  for (std::int64_t width = 1; width < blocks; width *= 2) {
    parallel_tasks(blocks / (2 * width), num_threads, [&](std::int64_t i) {
      std::inplace_merge(at(2 * i * width), at((2 * i + 1) * width), at((2 * i + 2) * width));
    });
  }
}

std::vector<std::int32_t> stable_order(const std::uint64_t* keys, std::int64_t count) {
  if (count > std::numeric_limits<std::int32_t>::max()) throw std::invalid_argument("more than 2^31 - 1 keys");
  auto from = large_array<Entry>(count), to = large_array<Entry>(count);
  std::vector<std::array<std::int32_t, kDigitMask + 1>> counts(kDigits);
  for (std::int64_t i = 0; i < count; ++i) {
    from[i] = {static_cast<std::uint32_t>(keys[i]), static_cast<std::uint32_t>(keys[i] >> 32),
               static_cast<std::int32_t>(i)};
    for (int number = 0; number < kDigits; ++number) ++counts[number][from[i].digit(number)];
  }
  for (int number = 0; number < kDigits; ++number) {
    auto& places = counts[number];
    if (std::find(places.begin(), places.end(), count) != places.end()) continue;  // constant digit
    check_interrupt();
    std::int32_t next = 0;
    for (std::int32_t& place : places) {
      const std::int32_t size = place;
      place = next;
      next += size;
    }
    for (std::int64_t i = 0; i < count; ++i) to[places[from[i].digit(number)]++] = from[i];
    from.swap(to);
  }
  std::vector<std::int32_t> order(count);
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = from[i].position;
  return order;
}

void radix_sort(UninitialisedVector<std::uint64_t>& keys, int begin_bit, int end_bit) {
  UninitialisedVector<std::uint64_t> sorted(keys.size());
  for (int shift = begin_bit; shift < end_bit; shift += kDigitBits) {
    check_interrupt();
    std::array<std::size_t, kDigitMask + 2> first{};
    for (const std::uint64_t key : keys) ++first[(key >> shift & kDigitMask) + 1];
    for (std::size_t digit = 1; digit < first.size(); ++digit) first[digit] += first[digit - 1];
    for (const std::uint64_t key : keys) sorted[first[key >> shift & kDigitMask]++] = key;
    keys.swap(sorted);
  }
}

}  // namespace radarsdf
