# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ctrl-C at many times during a fit and a mesh: the time until it ends, and whether a fit returns a map."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, Interrupted

from bench.growth.street import street
from bench.paper.report import markdown
from bench.timing import timed

MAX_WAIT_S = 1.0


def waits(work: Callable[[], Any], moments: int) -> tuple[float, np.ndarray, list[Any], list[str]]:
    """Interrupt `work` at `moments` random times.

    Returns
    -------
    whole_s : float
        Time of the work without interrupt.
    waits_s : (M,) float64
        Time from each signal to the end.
    maps : list
        Maps of the interrupted fits, or None.
    places : list of str
        Line of code at each signal.
    """
    rng = np.random.default_rng(0)
    with timed() as taken:
        work()
    whole_s = taken.wall_s
    found, maps, places = [], [], []
    for share in (np.arange(moments) + rng.random(moments)) / moments:
        sent_s = 0.0

        def press() -> None:
            nonlocal sent_s
            sent_s = time.perf_counter()
            places.append(_place())
            os.kill(os.getpid(), signal.SIGINT)

        timer = threading.Timer(0.95 * share * whole_s, press)
        with contextlib.suppress(KeyboardInterrupt):
            try:
                timer.start()
                work()
                timer.join()
            except Interrupted as stop:
                maps.append(stop.radar_map)
                raise
        if sent_s:
            found.append(time.perf_counter() - sent_s)
    return whole_s, np.array(found), maps, places


def _place() -> str:
    """File, line and function of this package that the main thread is running."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None and "radarsdf" not in Path(frame.f_code.co_filename).parts:
        frame = frame.f_back
    return (
        "–"
        if frame is None
        else f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}, {frame.f_code.co_name}"
    )


def run(returns: int, moments: int) -> bool:
    """Print the table for a fit of a street and for its mesh. True if no wait was longer than `MAX_WAIT_S`."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores SIGINT
    scans = street(returns)
    points, poses = scans.points, scans.poses
    config = FitConfig().override(training={"sdf_iterations": 100})
    radar_map = radarsdf.fit(points, poses, config=config, progress=False)
    rows, longest_s = [], 0.0
    works: dict[str, Callable[[], Any]] = {
        "fit": lambda: radarsdf.fit(points, poses, config=config, progress=False),
        "mesh": lambda: radar_map.mesh(0.2, progress=False),
    }
    for name, work in works.items():
        whole_s, wait_s, maps, places = waits(work, moments)
        longest_s = max(longest_s, wait_s.max())
        with_map = str(sum(m is not None for m in maps)) if name == "fit" else "–"
        rows.append(
            [name, f"{returns:,}", f"{whole_s:.1f}", str(len(wait_s)), with_map]
            + [f"{np.median(wait_s):.2f}", f"{wait_s.max():.2f}", places[int(wait_s.argmax())]]
        )
    print(
        markdown(
            [
                "work",
                "returns",
                "uninterrupted, s",
                "signals",
                "with a map",
                "median wait, s",
                "longest wait, s",
                "code at the longest wait",
            ],
            rows,
        )
    )
    return longest_s < MAX_WAIT_S
