"""Update a live map in a driver callback while another thread reads it.

    python examples/live.py

With ROS 2: ros2_node.py.
"""

from __future__ import annotations

import threading

import numpy as np
import radarsdf

drive = radarsdf.simulate.oculii(seed=5, frames=40)
given = drive.poses.copy()
given[:, :3, 3] += 0.02 * np.arange(len(given))[:, None] * [0.2, 1.0, 0.5]  # drifting poses
live = radarsdf.LiveMap()
done = threading.Event()


def on_scan(i: int) -> None:
    """Integrate a scan. A driver calls this."""
    integrated = live.integrate(drive.points[i], given[i], drive.intensities[i])
    if i % 10 == 0:
        print(f"scan {integrated.scan_id}: {len(integrated.blocks)} blocks changed")


def watch() -> None:
    """Mesh the map repeatedly, as a planner or viewer does. It never sees a partial scan and never blocks the driver."""
    while not done.wait(0.2):
        print(f"{len(live.mesh().faces)} triangles of {len(live)} scans")


watcher = threading.Thread(target=watch)
watcher.start()
for i in range(len(drive)):
    on_scan(i)

# A loop closure: move all scans to refined poses at once.
refined = radarsdf.refine_poses(drive.points, given)
changed = live.move_all(dict(zip(live.scan_ids, refined.poses, strict=True)))
done.set()
watcher.join()
print(f"{len(changed)} blocks changed with the poses: {refined.report['verdict']}")
print(f"{len(live.mesh().faces)} triangles in the end; as a map that does not grow: {live.map()}")
