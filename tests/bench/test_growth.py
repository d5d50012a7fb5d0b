"""Benches of growth and changes, and counted instructions."""

import numpy as np
from radarsdf.changes.changes import GONE, SAME, ChangedSurface, Changes
from radarsdf.simulate import Box
from radarsdf.simulate.materials import CONCRETE

from bench.changes import Change, areas, recalls
from bench.instructions import by_object, faults


def surface(places, kinds):
    """A small triangle at each place."""
    corner = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    vertices = (np.array(places, float)[:, None] + corner).reshape(-1, 3)
    count = len(vertices)
    faces = np.arange(count, dtype=np.int32).reshape(-1, 3)
    nothing = np.zeros(count, np.float32)
    return ChangedSurface(vertices, faces, np.repeat(np.array(kinds, np.int8), 3), nothing, nothing, nothing)


def test_recall_counts_the_cube_and_false_area_the_rest():
    cube = Change("taken out", 1.0, Box(np.zeros(3), np.full(3, 0.5), 0.0, CONCRETE), None)
    before = surface([[0.5, 0, 0], [-0.5, 0, 0], [0.7, 0, 0], [5, 0, 0]], [GONE, SAME, GONE, SAME])
    after = surface([[9, 0, 0], [8, 0, 0], [7, 0, 0]], [2, SAME, SAME])
    found = Changes(before, after, np.eye(4), {})
    np.testing.assert_allclose(recalls(found, cube), [1 / 2], rtol=1e-5)
    false, seen, near = (area / 0.005 for area in areas(found, [cube]))  # triangles
    np.testing.assert_allclose([false, seen, near], [1, 4, 2], rtol=1e-5)


_CALLGRIND = """positions: line
events: Ir
desc: Trigger: Client Request: joint

ob=(1) /usr/lib/libm.so.6
fl=(1) ???
fn=(1) exp
0 70
ob=(2) /a/b/_core.so
fn=(2) step
10 5
+2 6
cob=(1)
cfn=(1)
calls=3 0
* 70
cob=(3) /usr/lib/libc.so.6
cfn=(4) memcpy
calls=1 0
-1 9
* 7
ob=(3)
fn=(4)
0 9
"""


def test_costs_of_callees_are_exclusive():
    assert by_object(_CALLGRIND) == {"libm.so.6": 70, "_core.so": 18, "libc.so.6": 9}


def test_counts_above_the_limit_are_named():
    expected = {"quick fit": 1000, "joint": 100}
    assert faults({"quick fit": 1100, "joint": 50, "new": 9}, expected, 1.01) == []
    found = faults({"quick fit": 1200, "joint": 116}, expected, 1.2)
    assert [fault.partition(":")[0] for fault in found] == [
        *expected,
        "a step depends on the number of returns",
    ]
