"""``radarsdf live``: replay a recording as if its scans arrived now."""

from __future__ import annotations

import contextlib
import threading
import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check
from radarsdf.cli.inputs import check_address, inputs_of, scans_or_unposed
from radarsdf.cli.options import refuse_if
from radarsdf.cli.results import Results, until_stopped
from radarsdf.cli.settings import load_config
from radarsdf.io.files import check_outputs, checked_suffix
from radarsdf.io.poses import POSE_SUFFIXES, check_pose_times, write_poses
from radarsdf.live.live_map import LiveMap
from radarsdf.live.tracking import Lost
from radarsdf.scans import Scans
from radarsdf.view.pages import GrowingView
from radarsdf.view.serving import url_of

_SHOWN_EVERY_S = 0.5


@dataclass
class Replay:
    """Results of a replay: indices of integrated scans with their poses and seconds, and of the others."""

    rows: list[int] = field(default_factory=list)
    poses: list[NDArray[np.float64]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)  # the map was not ready
    lost: list[int] = field(default_factory=list)  # tracking failed for these scans without poses
    notes: tuple[str, ...] = ()  # what the pose of the last scan assumes


def replay(
    live: LiveMap,
    scans: Scans,
    *,
    with_poses: bool = True,
    rate: float = 1.0,
    on_scan: Callable[[Replay], None] | None = None,
) -> Replay:
    """Integrate scans at `rate` times the recorded speed; 0: as fast as possible. A scan is dropped once the next one arrives."""
    done, count = Replay(), len(scans.points)
    times_s = scans.times_s if scans.times_s is not None else 0.1 * np.arange(count)
    due_s = (times_s - times_s[0]) / rate if rate > 0 else np.full(count, -np.inf)
    labels = None if scans.T_body_sensor is None else scans.sensors
    begin = time.perf_counter()
    for i in range(count):
        now = time.perf_counter() - begin
        if rate > 0 and i + 1 < count and due_s[i + 1] <= now:
            done.dropped.append(i)
            continue
        time.sleep(max(due_s[i] - now, 0.0))
        started = time.perf_counter()
        try:
            found = live.integrate(
                scans.points[i],
                scans.poses[i] if with_poses else None,
                None if scans.intensities is None else scans.intensities[i],
                doppler_mps=None if scans.doppler_mps is None else scans.doppler_mps[i],
                time_s=float(times_s[i]),
                scan_id=i,
                sensor=None if labels is None else labels[i],
            )
        except Lost:
            done.lost.append(i)
            continue
        done.seconds.append(time.perf_counter() - started)
        done.rows.append(i)
        done.poses.append(found.pose)
        done.notes = found.notes
        for k, row in enumerate(done.rows):
            if row in found.moved:
                done.poses[k] = live.pose(row)
        if on_scan is not None:
            on_scan(done)
    return done


def live(given: Namespace, results: Results) -> None:
    """Replay the scans, report whether the map kept up, and write it."""
    refuse_if(not given.rate >= 0, f"--rate must be at least 0, not {given.rate}")
    out, trajectory = given.out, given.trajectory
    if trajectory is not None:
        checked_suffix(trajectory, POSE_SUFFIXES, "poses to write")
    check_outputs([out, trajectory], inputs_of(given))
    if given.view:
        check_address(given)
    scans, unposed = scans_or_unposed(given, find=given.find)
    timed = scans.times_s is not None or not unposed
    check(timed, f"{given.scans}: scans without poses need times, one per scan")
    if trajectory is not None:
        check_pose_times(trajectory, scans.times_s)
    growing = LiveMap(load_config(given), T_body_sensor=scans.T_body_sensor)
    with contextlib.ExitStack() as stack:
        shown = None
        if given.view:
            page = stack.enter_context(GrowingView(host=given.host, port=given.port))
            results.add(f"live map on {url_of(page.host, page.port)}; Ctrl-C ends it")
            shown = _PeriodicView(growing, page)
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


class _PeriodicView:
    """Callback after each scan that updates the page periodically, in its own thread."""

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
        with self._lock:
            self._page.show(self._map.mesh(), np.array(poses)[:, :3, 3])


def _add_rates(results: Results, done: Replay, scans: int) -> None:
    check(done.rows, "no scan was integrated into the map")
    in_map, dropped, lost = len(done.rows), len(done.dropped), len(done.lost)
    line = f"{in_map} of {scans} scans in the map, {dropped} dropped, {lost} lost"
    results.add("\n".join([line, *done.notes]), scans=in_map, dropped=dropped, lost=lost, notes=done.notes)
    hertz = in_map / max(sum(done.seconds), 1e-9)
    p50, p99, worst = np.percentile(done.seconds, [50, 99, 100])
    results.add(
        f"a scan took {1e3 * p50:.1f} ms (median), {1e3 * p99:.1f} ms (99th percentile), {1e3 * worst:.1f} ms (worst): "
        f"{hertz:.0f} scans per second",
        p50_s=p50,
        p99_s=p99,
        worst_s=worst,
        scans_per_second=hertz,
    )
