"""Plain marching cubes: cell by cell, with a dictionary from edges to vertices.

The compiled core is used only for the triangles of a pattern, on a single cell.
"""

import itertools
from functools import cache

import numpy as np
from radarsdf.map.marching_cubes import marching_cubes

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # C order
MIN_FRACTION = 1e-3


@cache
def cell_triangles(pattern):
    """Triangles of one cell as triples of (lower corner, upper corner)."""
    values = np.array([1.0 if pattern >> c & 1 else -1.0 for c in range(8)]).reshape(2, 2, 2)
    vertices, faces = marching_cubes(values)
    edges = []
    for vertex in vertices:  # all at the middle of their edges
        lower, upper = np.floor(vertex).astype(int), np.ceil(vertex).astype(int)
        edges.append((tuple(lower.tolist()), tuple(upper.tolist())))
    return [tuple(edges[v] for v in face) for face in faces]


def reference_marching_cubes(volume, level=0.0, spacing=(1, 1, 1), origin=(0, 0, 0), mask=None):
    """Same mesh as `radarsdf.map.marching_cubes.marching_cubes`, in another order."""
    usable = ~np.isnan(volume) if mask is None else mask & ~np.isnan(volume)
    vertex_of_edge, vertices, faces = {}, [], []
    for cell in itertools.product(*(range(n - 1) for n in volume.shape)):
        corners = [tuple(c) for c in (CORNERS + cell).tolist()]
        if not all(usable[c] for c in corners):
            continue
        pattern = sum(1 << i for i, c in enumerate(corners) if float(volume[c]) > level)
        for triangle in cell_triangles(pattern):
            face = []
            for lower, upper in triangle:
                a = tuple(np.add(cell, lower).tolist())
                b = tuple(np.add(cell, upper).tolist())
                if (a, b) not in vertex_of_edge:
                    vertex_of_edge[a, b] = len(vertices)
                    fraction = cut_fraction(float(volume[a]), float(volume[b]), level)
                    vertices.append((np.array(a) + fraction * np.subtract(b, a)) * spacing + origin)
                face.append(vertex_of_edge[a, b])
            faces.append(face)
    return np.array(vertices).reshape(-1, 3), np.array(faces, dtype=int).reshape(-1, 3)


def cut_fraction(a, b, level):
    """Where between samples a and b the level is crossed."""
    if np.isinf(a):
        fraction = 0.5 if np.isinf(b) else 1.0
    elif np.isinf(b):
        fraction = 0.0
    else:
        fraction = (level - a) / (b - a)
    return min(max(fraction, MIN_FRACTION), 1 - MIN_FRACTION)
