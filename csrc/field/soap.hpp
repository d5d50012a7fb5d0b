// SOAP (Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam", ICLR 2025) for the weights of a layer.
#pragma once

#include <cstdint>

namespace radarsdf {

// Shampoo maintains running averages of G G' and G' G of gradients G (rows, columns). SOAP is Adam on G rotated into
// their eigenbases, in which the components of G are nearly uncorrelated, so that individual step sizes are
// appropriate. A side too long for an eigenbasis is not rotated.
struct SoapMatrix {
  float* weights;         // (rows, columns)
  const float* gradient;  // (rows, columns)
  float* memory;          // state of soap_memory_size numbers, initially zero
  std::int64_t rows, columns;
};

std::int64_t soap_memory_size(std::int64_t rows, std::int64_t columns);

// `step` counts from 1.
void soap_step(const SoapMatrix& matrix, std::int64_t step, double learning_rate);

}  // namespace radarsdf
