# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The bench of changes counts what it says."""

import numpy as np
from radarsdf.changes.changes import GONE, SAME, ChangedSurface, Changes
from radarsdf.simulate import Box
from radarsdf.simulate.materials import CONCRETE

from bench.changes import Change, areas, recalls


def surface(places, kinds):
    """A small triangle at each place."""
    corner = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    vertices = (np.array(places, float)[:, None] + corner).reshape(-1, 3)
    count = len(vertices)
    faces = np.arange(count, dtype=np.int32).reshape(-1, 3)
    nothing = np.zeros(count, np.float32)
    return ChangedSurface(vertices, faces, np.repeat(np.array(kinds, np.int8), 3), nothing, nothing, nothing)


def test_recall_is_on_the_cube_and_false_area_away_from_it():
    cube = Change("taken out", 1.0, Box(np.zeros(3), np.full(3, 0.5), 0.0, CONCRETE), None)
    before = surface([[0.5, 0, 0], [-0.5, 0, 0], [0.7, 0, 0], [5, 0, 0]], [GONE, SAME, GONE, SAME])
    after = surface([[9, 0, 0], [8, 0, 0], [7, 0, 0]], [2, SAME, SAME])
    found = Changes(before, after, np.eye(4), {})
    np.testing.assert_allclose(recalls(found, cube), [1 / 2], rtol=1e-5)
    false, seen, near = (area / 0.005 for area in areas(found, [cube]))  # triangles
    np.testing.assert_allclose([false, seen, near], [1, 4, 2], rtol=1e-5)
