// Padded row length of matrices for the product kernels.
#pragma once

#include <cstdint>

#include "kernels/product_kernels.hpp"

namespace radarsdf {

constexpr std::int64_t padded(std::int64_t columns) {
  return (columns + kColumnBlock - 1) / kColumnBlock * kColumnBlock;
}

}  // namespace radarsdf
