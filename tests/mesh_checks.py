"""Fields with known level sets, and measurements on meshes."""

import itertools

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def grid(n, low=-1.0, high=1.0):
    return np.meshgrid(*[np.linspace(low, high, n)] * 3, indexing="ij")


def sphere(n):
    x, y, z = grid(n)
    return np.sqrt(x**2 + y**2 + z**2) - 0.8


def torus(n):
    x, y, z = grid(n)
    return np.hypot(np.hypot(x, y) - 0.6, z) - 0.25


def noise(seed, shape=(14, 15, 40), dtype=np.float32):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)


def plateaus(seed, shape=(14, 15, 40)):
    return np.random.default_rng(seed).integers(-1, 2, size=shape)


def directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def pair_keys(pairs):
    """A number for each pair of vertices (N, 2): NumPy compares numbers many times faster than rows."""
    return pairs[:, 0].astype(np.int64) << 32 | pairs[:, 1].astype(np.int64)


def single_edges(faces):
    """Edges of a single triangle; fails unless all others have two, with opposite directions."""
    edges = directed_edges(faces)
    assert len(np.unique(pair_keys(edges))) == len(edges), (
        "two triangles run along an edge in the same direction"
    )
    edges = np.sort(edges, axis=1)
    _, first, counts = np.unique(pair_keys(edges), return_index=True, return_counts=True)
    assert counts.max(initial=0) <= 2
    return edges[first[counts == 1]]


def has_single_cycle_links(faces, num_vertices):
    """True for each vertex whose triangles form one fan, closed or open."""
    # Corner i of a triangle shares an edge with the next corner and one with the previous corner.
    vertices = faces.T.reshape(-1)
    to_next = pair_keys(np.stack([vertices, np.roll(faces, -1, axis=1).T.reshape(-1)], 1))
    from_last = pair_keys(np.stack([vertices, np.roll(faces, 1, axis=1).T.reshape(-1)], 1))
    _, a, b = np.intersect1d(to_next, from_last, return_indices=True)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(vertices), len(vertices)))
    _, fans = connected_components(graph, directed=False)
    _, one_each = np.unique(fans, return_index=True)
    good = np.bincount(vertices[one_each], minlength=num_vertices) == 1
    for keys in (to_next, from_last):
        unique, counts = np.unique(keys, return_counts=True)
        good[unique[counts > 1] >> 32] = False  # two triangles run along an edge in the same direction
    return good


def euler_characteristic(vertices, faces):
    return len(vertices) - len(np.unique(pair_keys(np.sort(directed_edges(faces), axis=1)))) + len(faces)


def normals(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a) / 2


def area(vertices, faces):
    return np.linalg.norm(normals(vertices, faces), axis=1).sum()


def signed_volume(vertices, faces):
    return (normals(vertices, faces) * vertices[faces[:, 0]]).sum() / 3


def triangle_set(vertices, faces):
    """Triangles by position, each rotated so that its smallest vertex comes first, in sorted order."""
    triangles = vertices[faces]
    # Vertices have distinct positions, so their order by position identifies them.
    _, names = np.unique(vertices, axis=0, return_inverse=True)
    first = names.reshape(-1)[faces].argmin(axis=1)
    rotated = np.take_along_axis(triangles, ((first[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)
    flat = rotated.reshape(-1, 9)
    return flat[np.lexsort(flat.T)]


def same_mesh(mesh_a, mesh_b):
    a, b = triangle_set(*mesh_a), triangle_set(*mesh_b)
    return a.shape == b.shape and np.array_equal(a, b) and len(mesh_a[0]) == len(mesh_b[0])


def cells_in_use(volume, mask=None):
    usable = ~np.isnan(volume) if mask is None else mask & ~np.isnan(volume)
    shape = tuple(n - 1 for n in volume.shape)
    views = [
        usable[tuple(slice(o, o + n) for o, n in zip(offset, shape, strict=True))]
        for offset in itertools.product((0, 1), repeat=3)
    ]
    return np.logical_and.reduce(views)


def on_border(vertices, edges, cells):
    """Whether each edge lies in a face between a used and an unused cell."""
    padded = np.pad(cells, 1)
    ends = vertices[edges]
    answer = np.zeros(len(edges), dtype=bool)
    for axis in range(3):
        flat = (ends[:, 0, axis] == ends[:, 1, axis]) & (ends[:, 0, axis] % 1 == 0)
        upper = np.floor(ends.mean(axis=1)).astype(int) + 1  # + 1 for the padding
        lower = upper - np.eye(3, dtype=int)[axis]
        answer |= flat & (padded[tuple(upper.T)] != padded[tuple(lower.T)])
    return answer
