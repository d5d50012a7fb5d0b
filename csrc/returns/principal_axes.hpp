// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Eigenvalues and eigenvectors of many symmetric 3 x 3 matrices, by Jacobi's rotations. For matrices as small as these,
// LAPACK spends most of its time on the call itself.
#pragma once

#include <cstdint>

namespace radarsdf {

// matrices: (count, 3, 3), of which the upper triangles are read. values: (count, 3), ascending; vectors: (count, 3,
// 3), whose columns are of unit length, in the same order. A matrix that is not finite gives NaN.
void principal_axes(const double* matrices, std::int64_t count, double* values, double* vectors, int num_threads);

}  // namespace radarsdf
