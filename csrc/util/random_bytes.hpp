// Counter-based random bytes: each thread generates those that it needs, independent of the number of threads.
#pragma once

#include <cstdint>
#include <cstring>
#include <vector>

namespace radarsdf {

// Number `index` of the sequence of `seed`: SplitMix64 (Steele, Lea and Flood, OOPSLA 2014).
inline std::uint64_t random_word(std::uint64_t seed, std::uint64_t index) {
  std::uint64_t z = seed + (index + 1) * 0x9e3779b97f4a7c15u;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return z ^ (z >> 31);
}

// Rows of a matrix of random bytes. Each row starts with a new word.
class RandomRows {
 public:
  RandomRows(std::uint64_t seed, std::int64_t columns)
      : seed_(seed), words_((columns + 7) / 8), bytes_(8 * words_.size()) {}

  // Valid until the next call.
  const std::uint8_t* row(std::int64_t i) {
    const auto first = static_cast<std::uint64_t>(i) * words_.size();
    for (std::size_t w = 0; w < words_.size(); ++w) words_[w] = random_word(seed_, first + w);
    std::memcpy(bytes_.data(), words_.data(), bytes_.size());
    return bytes_.data();
  }

 private:
  std::uint64_t seed_;
  std::vector<std::uint64_t> words_;
  std::vector<std::uint8_t> bytes_;
};

}  // namespace radarsdf
