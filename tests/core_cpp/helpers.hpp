// Random data for several tests.
#pragma once

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

namespace test {

constexpr int kThreads[] = {1, 2, 7};  // results must not depend on them; 7 divides no size

template <typename T>
std::vector<T> normal_numbers(std::int64_t size, double scale, unsigned seed) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal(0.0, scale);
  std::vector<T> numbers(size);
  for (T& number : numbers) number = static_cast<T>(normal(generator));
  return numbers;
}

template <typename T>
std::vector<T> unit_vectors(std::int64_t count, unsigned seed) {
  std::vector<T> vectors = normal_numbers<T>(3 * count, 1, seed);
  for (std::size_t i = 0; i < vectors.size(); i += 3) {
    const T length =
        std::sqrt(vectors[i] * vectors[i] + vectors[i + 1] * vectors[i + 1] + vectors[i + 2] * vectors[i + 2]);
    for (std::size_t axis = 0; axis < 3; ++axis) vectors[i + axis] /= length;
  }
  return vectors;
}

}  // namespace test
