"""An exception between any two lines, or a forked process, leaves a live map equal to one of its scans."""

import os
import pathlib
import sys
import warnings

import pytest
import radarsdf
from radarsdf import LiveMap

from bench.live.removal import state

from .test_live_map import mesh_bits

PACKAGE = str(pathlib.Path(radarsdf.__file__).parent / "live")
SCENE = radarsdf.simulate.wall(frames=6)
POINTS = [points[::16] for points in SCENE.points]
ORIGIN = SCENE.poses[0, :3, 3]


def live_map(ids=range(4), **settings):
    live = LiveMap(origin=[0, 0, 0], **settings)
    for i in ids:
        live.integrate(POINTS[i], SCENE.poses[i], time_s=0.1 * i)
    return live


def interrupted(change, line):
    """Call `change`, with a KeyboardInterrupt before the line of this number. Return whether it has so many."""
    lines = 0

    def trace(frame, event, _):
        nonlocal lines
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        lines += event == "line"
        if lines == line:
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    sys.settrace(trace)
    try:
        change()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(None)
    return False


@pytest.mark.parametrize(
    ("change", "stored"),
    [
        (lambda live: live.integrate(POINTS[4], SCENE.poses[4]), True),
        (lambda live: live.integrate(POINTS[4], time_s=0.4), False),
        (lambda live: live.remove(1), True),
        (lambda live: live.move(1, SCENE.poses[2]), False),
        (lambda live: live.clear_outside(ORIGIN, 1.0), True),
    ],
    ids=["integrate", "track", "remove", "move", "clear_outside"],
)
def test_an_interruption_at_any_line_leaves_a_map_of_its_scans(change, stored, tmp_path):
    needed, line = live_map().num_bytes, 1
    while True:
        settings = {"max_bytes": needed - 10_000, "folder": tmp_path / str(line)} if stored else {}
        live = live_map(**settings)
        if stored:
            live.clear_outside(ORIGIN + [1000, 0, 0], 1.0)
        elif line % 20 == 1:
            live.mesh()
        if not interrupted(lambda live=live: change(live), line):
            break
        live.integrate(POINTS[5], SCENE.poses[5], scan_id=5)
        with live._state.whole():
            ids, bits = live.scan_ids, state(live)
        again = LiveMap(origin=[0, 0, 0])
        for i in ids:
            again.integrate(live._state.log.get(i).points, live.pose(i), scan_id=i)
        assert bits == state(again)
        if not stored and line % 20 == 1:
            grown = mesh_bits(live.mesh())
            live._state._surface = None
            assert grown == mesh_bits(live.mesh())
        line += 5 if stored else 1
    assert line > 30


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork")
def test_a_forked_process_leaves_the_map_and_its_folder_alone(tmp_path):
    live = live_map(folder=tmp_path)
    live.clear_outside(ORIGIN + [1000, 0, 0], 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork while threads run
        process = os.fork()
    if process == 0:
        refused = 0
        for call in (
            lambda: live.integrate(POINTS[4], SCENE.poses[4]),
            lambda: live.remove(0),
            lambda: live.move(0, SCENE.poses[3]),
            lambda: live.clear_outside(ORIGIN, 1e6),
            lambda: live.save(tmp_path / "live.npz"),
            live.mesh,
            live.map,
            live.finish,
        ):
            try:
                call()
            except RuntimeError:
                refused += 1
        del live
        os._exit(refused)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 8
    with pytest.raises(BlockingIOError):  # still locked
        LiveMap(folder=tmp_path)
    live.clear_outside(ORIGIN, 1e6)
    live.integrate(POINTS[4], SCENE.poses[4])
    with live._state.whole():
        assert state(live) == state(live_map(range(5)))
