# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf live``: a recording as if its scans were arriving now."""

from __future__ import annotations

import contextlib
import threading
import time
from argparse import Namespace

import numpy as np
from numpy.typing import NDArray

from radarsdf.cli.app import refuse_if
from radarsdf.cli.inputs import check_address, inputs_of, scans_or_unposed
from radarsdf.cli.results import Results, until_stopped
from radarsdf.cli.settings import load_config
from radarsdf.io.files import check_outputs
from radarsdf.io.poses import check_pose_suffix, check_pose_times, write_poses
from radarsdf.live.live_map import LiveMap
from radarsdf.live.replay import Replay, replay
from radarsdf.view.pages import GrowingView
from radarsdf.view.serving import url_of

_SHOWN_EVERY_S = 0.5


def live(given: Namespace, results: Results) -> None:
    """Replay the scans, report how the map kept up, and write it."""
    refuse_if(not given.rate >= 0, f"--rate must be at least 0, not {given.rate}")
    out, trajectory = given.out, given.trajectory
    if trajectory is not None:
        check_pose_suffix(trajectory)
    check_outputs([out, trajectory], inputs_of(given))
    if given.view:
        check_address(given)
    scans, unposed = scans_or_unposed(given, find=given.find)
    if unposed and scans.times_s is None:
        msg = f"{given.scans}: scans without poses need times: when each was taken"
        raise ValueError(msg)
    if trajectory is not None:
        check_pose_times(trajectory, scans.times_s)
    growing = LiveMap(load_config(given))
    with contextlib.ExitStack() as stack:
        shown = None
        if given.view:
            page = stack.enter_context(GrowingView(host=given.host, port=given.port))
            results.add(f"the map grows on {url_of(page.host, page.port)}; Ctrl-C ends it")
            shown = _Shown(growing, page)
        done = replay(growing, scans, with_poses=not unposed, rate=given.rate, on_scan=shown)
        _add_rates(results, done, len(scans))
        if out is not None:
            made = growing.map() if given.quick else growing.finish(progress=results.progress)
            made.save(out)
            results.add(f"map {out}", out=out)
        if trajectory is not None:
            times_s = None if scans.times_s is None else scans.times_s[done.rows]
            write_poses(trajectory, np.stack(done.poses), times_s)
            results.add(f"trajectory {trajectory}", trajectory=trajectory)
        if shown is not None:
            shown.show(done.poses)
            results.end()
            until_stopped(page)


class _Shown:
    """Called after each scan, shows the surface from time to time, from a thread."""

    def __init__(self, live_map: LiveMap, page: GrowingView) -> None:
        self._map, self._page = live_map, page
        self._thread, self._lock = threading.Thread(), threading.Lock()
        self._next_s = 0.0

    def __call__(self, done: Replay) -> None:
        if not self._thread.is_alive() and time.monotonic() > self._next_s:
            self._next_s = time.monotonic() + _SHOWN_EVERY_S
            self._thread = threading.Thread(target=self.show, args=[list(done.poses)], daemon=True)
            self._thread.start()

    def show(self, poses: list[NDArray[np.float64]]) -> None:
        """Show the surface now, and the path of these poses."""
        with self._lock:
            self._page.show(self._map.mesh(), np.array(poses)[:, :3, 3])


def _add_rates(results: Results, done: Replay, scans: int) -> None:
    if not done.rows:
        msg = "no scan came into the map"
        raise ValueError(msg)
    in_map, dropped, lost = len(done.rows), len(done.dropped), len(done.lost)
    line = f"{in_map} of {scans} scans in the map, {dropped} dropped, {lost} lost"
    results.add(line, scans=in_map, dropped=dropped, lost=lost)
    p50, p99, worst = np.percentile(done.seconds, [50, 99, 100])
    results.add(
        f"a scan took {1e3 * p50:.1f} ms (median), {1e3 * p99:.1f} ms (99 of 100), {1e3 * worst:.1f} ms (worst): "
        f"{done.hertz:.0f} scans a second",
        p50_s=p50,
        p99_s=p99,
        worst_s=worst,
        scans_per_second=done.hertz,
    )
