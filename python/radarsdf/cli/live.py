# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf live``: a recording given to a growing map, as a driver would."""

from __future__ import annotations

import argparse
import contextlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.options import add_address, add_fit_options, add_json, check_address, config_of, progress_of
from radarsdf.cli.results import Results, counted
from radarsdf.cli.saving import save_map
from radarsdf.cli.saying import say, until_stopped
from radarsdf.cli.scans_in import add_scans, inputs_of, scans_of

if TYPE_CHECKING:
    from radarsdf import LiveMap
    from radarsdf.io.scans import Scans
    from radarsdf.live.replay import Replay
    from radarsdf.view.pages import GrowingView

_SHOWN_EVERY_S = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser)
    parser.add_argument("-o", "--out", type=Path, help="the map to write in the end, .safetensors")
    parser.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="also write where the scans were put: .tum, .kitti or .npy",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=1.0,
        metavar="R",
        help="replay at R times the recorded speed, of 0.1 s a scan without times; 0: as fast as possible; default: 1",
    )
    parser.add_argument(
        "--find", action="store_true", help="do not use the poses of the scans: track them on the last ones"
    )
    parser.add_argument("--view", action="store_true", help="show the map in the browser while it grows")
    add_address(parser)
    add_fit_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Replay the scans, say how the map kept up, and write it."""
    from radarsdf.checks import not_negative
    from radarsdf.io.files import check_outputs
    from radarsdf.io.poses.files import check_pose_suffix, check_pose_times, write_poses

    config = config_of(options)
    rate = not_negative(options.rate, "--rate")
    if options.trajectory is not None:
        check_pose_suffix(options.trajectory)
    check_outputs([options.out, options.trajectory], inputs_of(options))
    if options.view:
        check_address(options)
    scans, with_poses = _read(options)
    if options.trajectory is not None:
        check_pose_times(options.trajectory, scans.times_s)
    results = Results(options)

    from radarsdf.live.live_map import LiveMap
    from radarsdf.live.replay import replay

    live = LiveMap(config)
    with contextlib.ExitStack() as stack:
        shown = None
        if options.view:
            from radarsdf.view.pages import GrowingView

            shown = _Shown(live, stack.enter_context(GrowingView(host=options.host, port=options.port)))
            stack.callback(shown.stop)
        done = replay(
            live, scans, with_poses=with_poses, rate=rate, on_scan=None if shown is None else shown.on_scan
        )
        _say_rates(done, scans, results)
        if options.out is not None:
            radar_map = live.map() if options.quick else live.finish(progress=progress_of(options))
            save_map(radar_map, options.out)
            results.add(f"map {options.out}", out=options.out)
        if options.trajectory is not None:
            import numpy as np

            times_s = None if scans.times_s is None else scans.times_s[done.rows]
            write_poses(options.trajectory, np.stack(done.poses), times_s)
            results.add(f"trajectory {options.trajectory}", trajectory=options.trajectory)
        results.end()
        if shown is not None:
            until_stopped(shown.view)


def _read(options: argparse.Namespace) -> tuple[Scans, bool]:
    """The scans, and whether their poses are to be used."""
    from radarsdf.io.poses.trajectory import UNPOSED, NoPoses

    if not options.find:
        with contextlib.suppress(NoPoses):
            return scans_of(options), True
    scans = scans_of(options, UNPOSED)
    if scans.times_s is None:
        msg = "scans without poses need times: when each was taken"
        raise ValueError(msg)
    return scans, False


def _say_rates(done: Replay, scans: Scans, results: Results) -> None:
    import numpy as np

    if not done.rows:
        msg = "no scan came into the map"
        raise ValueError(msg)
    p50, p99, worst = 1e3 * np.percentile(done.seconds, [50, 99, 100])
    results.add(
        f"{len(done.rows)} of {counted(len(scans), 'scan')} in the map, {len(done.dropped)} dropped, {len(done.lost)} lost",
        scans=len(done.rows),
        dropped=len(done.dropped),
        lost=len(done.lost),
    )
    results.add(
        f"a scan took {p50:.1f} ms (median), {p99:.1f} ms (99 of 100), {worst:.1f} ms (worst): {done.hertz:.0f} scans a second",
        p50_s=p50 / 1e3,
        p99_s=p99 / 1e3,
        worst_s=worst / 1e3,
        scans_per_second=done.hertz,
    )


class _Shown:
    """A thread that shows the newest surface from time to time."""

    def __init__(self, live: LiveMap, view: GrowingView) -> None:
        from radarsdf.view.serving import url_of

        self._live, self.view = live, view
        self._path: Any = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        say(f"the map grows on {url_of(view.host, view.port)}; Ctrl-C ends it")

    def on_scan(self, done: Replay) -> None:
        self._path = [pose[:3, 3] for pose in done.poses]

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        import numpy as np

        while not self._ended.wait(_SHOWN_EVERY_S):
            path, self._path = self._path, None
            if path is not None:
                self.view.show(self._live.mesh(), np.array(path))
