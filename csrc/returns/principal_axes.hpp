// Eigendecomposition of many symmetric 3 x 3 matrices by Jacobi rotations. For such small matrices, call overhead
// dominates in LAPACK.
#pragma once

#include <cstdint>

namespace radarsdf {

// matrices: (count, 3, 3), upper triangles. values: (count, 3), ascending; vectors: (count, 3, 3), unit columns in the
// same order. Non-finite matrices give NaN.
void principal_axes(const double* matrices, std::int64_t count, double* values, double* vectors, int num_threads);

}  // namespace radarsdf
