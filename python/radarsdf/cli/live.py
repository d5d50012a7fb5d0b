# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf live``: a recording as if its scans were arriving now."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from radarsdf.cli.options import Address, Recording, Settings
from radarsdf.cli.results import Results, counted, save_map, until_stopped
from radarsdf.cli.scans import scans_or_unposed

if TYPE_CHECKING:
    from radarsdf import LiveMap
    from radarsdf.live.replay import Replay
    from radarsdf.view.pages import GrowingView

_SHOWN_EVERY_S = 0.5


def live(
    recording: Recording,
    *,
    out: Path | None = None,
    trajectory: Path | None = None,
    rate: float = 1.0,
    find: bool = False,
    view: bool = False,
    address: Address,
    settings: Settings,
    results: Results,
) -> None:
    """Replay the scans, report how the map kept up, and write it.

    out: The map to write in the end, .safetensors.
    trajectory: Also write where the scans were placed: .tum, .kitti or .npy.
    rate: Multiplies the recorded speed, which is 0.1 s a scan without times; 0: as fast as possible.
    find: Do not use the poses of the scans: track each scan on the last ones.
    view: Show the map in the browser while it grows.
    """
    import numpy as np

    from radarsdf.checks import not_negative
    from radarsdf.io.files import check_outputs
    from radarsdf.io.poses import check_pose_suffix, check_pose_times, write_poses
    from radarsdf.live.live_map import LiveMap
    from radarsdf.live.replay import replay

    config, rate = settings.load(), not_negative(rate, "--rate")
    if trajectory is not None:
        check_pose_suffix(trajectory)
    check_outputs([out, trajectory], recording.inputs)
    if view:
        address.check()
    scans, missing = scans_or_unposed(recording, find=find)
    with_poses = missing is None and not find
    if not with_poses and scans.times_s is None:
        msg = f"{recording.scans}: scans without poses need times: when each was taken"
        raise ValueError(msg)
    if trajectory is not None:
        check_pose_times(trajectory, scans.times_s)
    growing = LiveMap(config)
    with contextlib.ExitStack() as stack:
        page = on_scan = None
        if view:
            from radarsdf.view.pages import GrowingView

            page = stack.enter_context(GrowingView(host=address.host, port=address.port))
            on_scan = stack.enter_context(_shown(growing, page))
        done = replay(growing, scans, with_poses=with_poses, rate=rate, on_scan=on_scan)
        _add_rates(results, done, len(scans))
        if out is not None:
            save_map(growing.map() if settings.quick else growing.finish(progress=results.progress), out)
            results.add(f"map {out}", out=out)
        if trajectory is not None:
            times_s = None if scans.times_s is None else scans.times_s[done.rows]
            write_poses(trajectory, np.stack(done.poses), times_s)
            results.add(f"trajectory {trajectory}", trajectory=trajectory)
        if page is not None:
            results.end()
            until_stopped(page)


def _add_rates(results: Results, done: Replay, scans: int) -> None:
    import numpy as np

    if not done.rows:
        msg = "no scan came into the map"
        raise ValueError(msg)
    counts = {"scans": len(done.rows), "dropped": len(done.dropped), "lost": len(done.lost)}
    in_map, dropped, lost = counts.values()
    line = f"{in_map} of {counted(scans, 'scan')} in the map, {dropped} dropped, {lost} lost"
    results.add(line, **counts)
    p50, p99, worst = np.percentile(done.seconds, [50, 99, 100])
    results.add(
        f"a scan took {1e3 * p50:.1f} ms (median), {1e3 * p99:.1f} ms (99 of 100), {1e3 * worst:.1f} ms (worst): "
        f"{done.hertz:.0f} scans a second",
        p50_s=p50,
        p99_s=p99,
        worst_s=worst,
        scans_per_second=done.hertz,
    )


@contextlib.contextmanager
def _shown(live_map: LiveMap, page: GrowingView) -> Iterator[Callable[[Replay], None]]:
    """Show the newest surface from time to time, by a thread; yields the function that the replay calls after a scan."""
    import numpy as np

    from radarsdf.view.serving import url_of

    newest: list[Any] = []  # poses: none, or of the last scan that came
    ended = threading.Event()

    def on_scan(done: Replay) -> None:
        newest[:] = [list(done.poses)]

    def work() -> None:
        while not ended.wait(_SHOWN_EVERY_S):
            if newest:
                page.show(live_map.mesh(), np.array([pose[:3, 3] for pose in newest.pop()]))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    typer.echo(f"the map grows on {url_of(page.host, page.port)}; Ctrl-C ends it")
    try:
        yield on_scan
    finally:
        ended.set()
        thread.join()
