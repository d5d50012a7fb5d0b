// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// SOAP (Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam", ICLR 2025) for the weights of a layer.
#pragma once

#include <cstdint>

namespace radarsdf {

// Of gradients G (rows, columns), Shampoo keeps running sums of G G' and G' G. SOAP is Adam on G turned into the bases
// of their eigenvectors: there the numbers of G hardly depend on each other, so that steps of their own lengths are
// right. A side too long for such a sum keeps its own axes.
template <typename T>
struct SoapMatrix {
  T* weights;         // (rows, columns)
  const T* gradient;  // likewise
  T* memory;          // soap_memory_size numbers, zero before the first step
  std::int64_t rows, columns;
};

std::int64_t soap_memory_size(std::int64_t rows, std::int64_t columns);

// `step` counts from 1.
template <typename T>
void soap_step(const SoapMatrix<T>& matrix, std::int64_t step, double learning_rate);

}  // namespace radarsdf
