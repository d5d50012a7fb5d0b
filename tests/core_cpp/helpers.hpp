// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What several tests need.
#pragma once

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "lattice/cell_set.hpp"
#include "lattice/vertex_table.hpp"
#include "util/instruction_set.hpp"

namespace test {

constexpr int kThreads[] = {1, 2, 7};  // results must not depend on them; 7 divides nothing

template <typename T>
std::vector<T> normal_numbers(std::int64_t size, double scale, unsigned seed) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal(0.0, scale);
  std::vector<T> numbers(static_cast<std::size_t>(size));
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

template <typename T>
double dot(const std::vector<T>& a, const std::vector<T>& b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += static_cast<double>(a[i]) * static_cast<double>(b[i]);
  return sum;
}

// The table of the cells that hold the points.
template <typename T>
radarsdf::VertexTable table_of(const std::vector<T>& points, double leaf_size_m, int num_levels,
                               radarsdf::Encoding encoding, int num_threads = 1) {
  radarsdf::CellSet cells(leaf_size_m);
  cells.insert(points.data(), static_cast<std::int64_t>(points.size()) / 3, num_threads);
  return radarsdf::VertexTable(cells.sorted_keys(num_threads), leaf_size_m, num_levels, encoding, num_threads);
}

// Runs a test on every instruction set of this processor.
template <typename Body>
void for_each_instruction_set(const Body& body) {
  const radarsdf::InstructionSet before = radarsdf::instruction_set();
  for (const radarsdf::InstructionSet isa : radarsdf::available_instruction_sets()) {
    radarsdf::set_instruction_set(isa);
    body();
  }
  radarsdf::set_instruction_set(before);
}

}  // namespace test
