# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Products of matrices whose bits do not depend on threads: `np.einsum` without `optimize` calls no BLAS.

BLAS, which NumPy calls for `@`, splits a large product among its threads, and their number decides the order of the sums
and so the last bits. LAPACK solves few equations with one thread.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]


def product(a: NDArray[Any], b: NDArray[Any]) -> _Floats:
    """(N, M) product of the matrices a (N, K) and b (K, M), float64."""
    return np.asarray(np.einsum("ik,kj->ij", a, b, dtype=np.float64))


def normal_matrix(a: NDArray[Any], b: NDArray[Any]) -> _Floats:
    """(K, M) sums over the rows of a (N, K) and b (N, M) of their products, float64: aᵀ b."""
    return np.asarray(np.einsum("ni,nj->ij", a, b, dtype=np.float64))


def turned(points: NDArray[Any], R: NDArray[Any]) -> _Floats:
    """(N, 3) points, each turned by the matrix R (3, 3), float64: points Rᵀ."""
    # Coordinate by coordinate, which is as fast as BLAS; row by row takes three times as long.
    columns = np.ascontiguousarray(points.T, np.float64)
    return np.ascontiguousarray(np.einsum("ij,jn->in", R, columns).T)  # the core takes rows that lie together
