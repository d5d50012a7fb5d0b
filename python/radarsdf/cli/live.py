"""``radarsdf live``: replay a recording as if its scans arrived now, or map running ROS 2 topics."""

import threading
import time
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.cli import Results, warn
from radarsdf.cli.inputs import inputs_of, request_of_topics, scans_or_unposed
from radarsdf.cli.options import refuse_if
from radarsdf.cli.settings import load_config
from radarsdf.grids.occupancy import grid as grid_of
from radarsdf.interrupts import deferred_interrupts
from radarsdf.io.dds import Node
from radarsdf.io.files import check_outputs, checked_suffix
from radarsdf.io.poses import POSE_SUFFIXES, check_pose_times, write_poses
from radarsdf.io.subscription import Subscription
from radarsdf.live.live_map import Integrated, LiveMap
from radarsdf.live.store import ScanId
from radarsdf.poses.search import Lost
from radarsdf.rig import Label
from radarsdf.scans import Scan, Scans
from radarsdf.view.foxglove import foxglove_sink
from radarsdf.view.pages import GrowingView
from radarsdf.view.rerun import rerun_sink
from radarsdf.view.ros2 import Ros2Sink
from radarsdf.view.serving import WAIT_STEP_S, wait
from radarsdf.view.sinks import Sink

_SHOWN_EVERY_S = 0.5
_GRID_SHARE = 0.05  # share of the time spent on free space, for which a map is fitted anew
_MAX_VOXELS = 500_000
_MAX_PATH = 2000  # positions of the trajectory shown
_TIMED = 10_000  # last scans whose durations are reported


@dataclass
class Replay:
    """Numbers of scans of a replay, and how long the last ones took."""

    integrated: int = 0
    dropped: int = 0  # the map was not ready, or ROS 2 knew no pose
    lost: int = 0  # tracking failed for these scans without poses
    seconds: deque[float] = field(default_factory=lambda: deque(maxlen=_TIMED))
    notes: tuple[str, ...] = ()  # what the pose of the last scan assumes


def replay(
    live: LiveMap,
    scans: Scans | Subscription,
    *,
    with_poses: bool = True,
    rate: float = 1.0,
    on_scan: Callable[[Scan, Integrated], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Replay:
    """Integrate scans at `rate` times the recorded speed; 0: as fast as possible. A scan is dropped once the next one arrives."""
    done, before, known, tried, why = Replay(), len(live), len(live.scan_ids), 0, ""
    # A node goes on after a scan that does not fit, such as one with a repeated time.
    unusable = Lost if isinstance(scans, Scans) else ValueError
    for scan in _due(scans, rate, done, stopped) if isinstance(scans, Scans) else scans:
        if isinstance(scans, Subscription) and scans.remounted():
            for scan_id in live.scan_ids[known:]:
                live.remove(scan_id)
        started = time.perf_counter()
        tried += 1
        try:
            found = live.integrate(
                scan.points,
                scan.T_world_sensor if with_poses else None,
                scan.intensities,
                doppler_mps=scan.doppler_mps,
                time_s=scan.time_s,
                sensor=scan.sensor,
                sigmas=scan.sigma,
            )
        except unusable as error:
            why = f"The last scan that was lost: {error}"
            continue
        done.seconds.append(time.perf_counter() - started)
        done.notes = found.notes
        if on_scan is not None:
            on_scan(scan, found)
    done.integrated = len(live) - before
    done.lost = tried - done.integrated
    done.notes += (why,) if why else ()
    if isinstance(scans, Subscription):
        done.dropped = scans.dropped + scans.unplaced
    return done


def _due(scans: Scans, rate: float, done: Replay, stopped: Callable[[], bool]) -> Iterator[Scan]:
    """Yield the scans that are not dropped when they are due, with their poses of a body, and labels of mounted radars."""
    count = len(scans.points)
    times_s = np.asarray(0.1 * np.arange(count) if scans.times_s is None else scans.times_s)
    due_s = (times_s - times_s[0]) / rate if rate > 0 else np.full(count, -np.inf)
    begin = time.perf_counter()
    for i, scan in enumerate(scans):
        now = time.perf_counter() - begin
        if rate > 0 and i + 1 < count and due_s[i + 1] <= now:
            done.dropped += 1
            continue
        left_s = due_s[i] - now
        while left_s > 0 and not stopped():
            time.sleep(min(left_s, WAIT_STEP_S))
            left_s -= WAIT_STEP_S
        if stopped():
            return
        sensor = None if scans.T_body_sensor is None else scan.sensor
        yield replace(scan, T_world_sensor=scans.poses[i], time_s=float(times_s[i]), sensor=sensor)


def live(given: Namespace, results: Results) -> None:
    refuse_if(not given.rate >= 0, f"--rate must be at least 0, not {given.rate}")
    request, begin = request_of_topics(given), given.map
    changed = begin and (given.config or given.set or given.paper)
    refuse_if(changed, f"settings are those of the map {begin}: leave out --config, --set and --paper")
    checked_suffix(given.trajectory, POSE_SUFFIXES, "poses to write")
    check_outputs([given.out, given.trajectory, given.mcap, given.rrd], inputs_of(given))
    with ExitStack() as servers, ExitStack() as files:
        sinks = _opened_sinks(given, servers, files)
        urls = [sink.url for sink in sinks if sink.url]
        scans: Scans | Subscription
        if request is None:
            scans, unposed = _recording(given)
        with deferred_interrupts() as stopped:
            if request is not None:
                node = servers.enter_context(closing(Node(given.ros2_domain, given.host)))
                scans = Subscription(node, given.ros2, request, given.find, stopped, warn)
                sinks, unposed = [*sinks, Ros2Sink(scans)], scans.unposed
                topics = ", ".join(given.ros2)
                results.add(f"{topics} mapped, the map published as /radarsdf/…; Ctrl-C ends it")
            folder = None if request is None else servers.enter_context(_folder_near(given.out))
            if begin is None:
                growing = LiveMap(load_config(given), folder=folder, T_body_sensor=scans.T_body_sensor)
            else:
                growing = LiveMap.load(begin, folder=folder)
            if urls:
                results.say(f"live map on {' and '.join(urls)}; Ctrl-C ends it")
            shown = _Shown(growing, scans.T_body_sensor, sinks) if sinks else None
            paced = {"rate": given.rate, "on_scan": shown, "stopped": stopped}
            done = replay(growing, scans, with_poses=not unposed, **paced)
        _add_replay(results, done)
        _close_and_save(given, results, growing, done.integrated)
        if shown is not None:
            shown.show(final=True)
        files.close()
        if urls and request is None and not stopped():
            with results.until_stopped():
                wait()


def _recording(given: Namespace) -> tuple[Scans, bool]:
    scans, unposed = scans_or_unposed(given, find=given.find)
    timed = len(scans.points) and (scans.times_s is not None or not unposed)
    check(timed, f"{given.scans}: scans without poses need times, one per scan")
    check_pose_times(given.trajectory, scans.times_s)
    return scans, unposed


def _folder_near(out: Path | None) -> TemporaryDirectory[str]:
    """Create a folder for the scans of hours of driving, of which memory holds only the last ones. /tmp may be memory."""
    parent = None if out is None else out.absolute().parent
    return TemporaryDirectory(prefix="radarsdf-", dir=parent, ignore_cleanup_errors=True)


def _close_and_save(given: Namespace, results: Results, live_map: LiveMap, integrated: int) -> None:
    if not live_map.sealed_scans and len(live_map.close_loops()):
        results.add("loops of the trajectory closed")
    if given.out is not None:
        made = live_map.map() if given.quick else live_map.finish(progress=results.progress)
        made.save(given.out)
        results.add_file("map", given.out)
    if given.trajectory is not None:
        times_s, poses = (column[-integrated:] for column in live_map.trajectory())
        write_poses(given.trajectory, poses, times_s)
        results.add_file("trajectory", given.trajectory, "trajectory")


def _opened_sinks(given: Namespace, servers: ExitStack, files: ExitStack) -> list[Sink]:
    opened: list[Sink] = []
    if given.view:
        opened.append(servers.enter_context(GrowingView(host=given.host, port=given.port)))
    of_viewers = (foxglove_sink, given.foxglove, given.mcap), (rerun_sink, given.rerun, given.rrd)
    for open_sink, served, path in of_viewers:
        if served:
            opened.append(servers.enter_context(open_sink(None)))
        if path is not None:
            opened.append(files.enter_context(open_sink(path)))
    return opened


class _Shown:
    """Callback after each scan that passes it to all sinks, and periodically the surface and free space, in its own thread."""

    def __init__(
        self, live_map: LiveMap, mountings: Mapping[Label, Floats] | None, sinks: list[Sink]
    ) -> None:
        self._map, self._mountings, self._sinks = live_map, mountings, sinks
        self._path: dict[ScanId, Floats] = {}  # positions of every n-th scan
        self._every, self._scans, self._time_s = 1, 0, 0.0
        self._thread, self._lock = threading.Thread(), threading.Lock()
        self._next_s, self._next_grid_s = 0.0, 0.0

    def __call__(self, scan: Scan, found: Integrated) -> None:
        T = found.pose if self._mountings is None else found.pose @ self._mountings[scan.sensor]
        scan, self._time_s = replace(scan, T_world_sensor=T), scan.time_s or 0.0
        for sink in self._sinks:
            sink.show_scan(scan, self._time_s)
        if self._scans % self._every == 0:
            self._path = self._path | {found.scan_id: found.pose[:3, 3]}
        for scan_id in self._path.keys() & set(found.moved):
            self._path[scan_id] = self._map.pose(scan_id)[:3, 3]
        if len(self._path) > _MAX_PATH:
            self._path, self._every = dict([*self._path.items()][::2]), 2 * self._every
        self._scans += 1
        if not self._thread.is_alive() and time.monotonic() > self._next_s:
            self._next_s = time.monotonic() + _SHOWN_EVERY_S
            self._thread = threading.Thread(target=self.show, daemon=True)
            self._thread.start()

    def show(self, final: bool = False) -> None:
        with self._lock:
            if final:  # loops may have been closed
                known = zip(self._map.scan_ids, self._map.trajectory()[1], strict=True)
                self._path = {scan_id: pose[:3, 3] for scan_id, pose in known if scan_id in self._path}
            mesh, path, time_s = self._map.mesh(), np.array([*self._path.values()]), self._time_s
            for sink in self._sinks if len(mesh.faces) else ():
                sink.show_surface(mesh, path, time_s)
            began_s = time.monotonic()
            if self._map.config.returns.free_space and (final or began_s >= self._next_grid_s):
                made = self._map.map()
                edge_m = float(np.cbrt(np.prod(np.ptp(made.extent, axis=0)) / _MAX_VOXELS))
                grid = grid_of(made, made.extent, max(made.config.leaf_size_m, edge_m))
                for sink in self._sinks:
                    sink.show_grid(grid, time_s)
                self._next_grid_s = time.monotonic() + (time.monotonic() - began_s) / _GRID_SHARE


def _add_replay(results: Results, done: Replay) -> None:
    check(done.integrated, "; ".join(["no scan was integrated into the map", *done.notes]))
    scans = done.integrated + done.dropped + done.lost
    line = f"{done.integrated} of {scans} scans in the map, {done.dropped} dropped, {done.lost} lost"
    counts = {"scans": done.integrated, "dropped": done.dropped, "lost": done.lost}
    results.add("\n".join([line, *done.notes]), **counts, notes=done.notes)
    hertz = len(done.seconds) / max(sum(done.seconds), 1e-9)
    p50_s, p99_s, worst_s = np.percentile(done.seconds, [50, 99, 100])
    took = f"{1e3 * p50_s:.1f} ms (median), {1e3 * p99_s:.1f} ms (99th percentile), {1e3 * worst_s:.1f} ms (worst)"
    values = {"p50_s": p50_s, "p99_s": p99_s, "worst_s": worst_s, "scans_per_second": hertz}
    results.add(f"a scan took {took}: {hertz:.0f} scans per second", **values)
