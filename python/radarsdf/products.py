"""Matrix products with bits that do not depend on threads: `np.einsum` without `optimize` calls no BLAS.

BLAS, which NumPy calls for `@`, splits a large product among its threads, and their number determines the order of the sums
and so the last bits. LAPACK solves small systems with one thread.
"""

import numpy as np

from radarsdf.arrays import Array, Floats


def product(a: Array, b: Array) -> Floats:
    """(N, M) product of the matrices a (N, K) and b (K, M), float64."""
    return np.asarray(np.einsum("ik,kj->ij", a, b, dtype=np.float64))


def normal_matrix(a: Array, b: Array) -> Floats:
    """(K, M) product aᵀ b of a (N, K) and b (N, M), float64."""
    return np.asarray(np.einsum("ni,nj->ij", a, b, dtype=np.float64))


def turned(points: Array, R: Array) -> Floats:
    """(N, 3) points rotated by the matrix R (3, 3), float64: points Rᵀ."""
    # By coordinate, which is as fast as BLAS; by row takes three times as long.
    columns = np.ascontiguousarray(points.T, np.float64)
    return np.ascontiguousarray(np.einsum("ij,jn->in", R, columns).T)  # the core needs contiguous rows


def transformed(points: Array, T: Array) -> Floats:
    """(N, 3) points transformed by the pose T (4, 4), float64."""
    return turned(points, T[:3, :3]) + T[:3, 3]
