"""
Map while driving
=================

Integrate scans one by one, leave out moving returns by their Doppler, and correct all poses after a loop closure.
"""

import threading

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.render.picture import render
from radarsdf.simulate import Box, Scene, simulate
from radarsdf.simulate.materials import METAL

# %%
# A car drives 12 m ahead of the radar, at its speed of 20 m/s: its Doppler is 0, that of the street is not.

street = radarsdf.simulate.hugin(frames=30)
car_sensor, half_m = np.array([12.0, 0.0, -0.7]), np.array([2.0, 0.9, 0.7])  # centre, half of its extents
velocity = np.gradient(street.poses[:, :3, 3], 0.1, axis=0)
rng = np.random.default_rng(0)
points, doppler_mps = [], []
for i, T in enumerate(street.poses):
    car = Box(T[:3, :3] @ car_sensor + T[:3, 3], half_m, np.arctan2(T[1, 0], T[0, 0]), METAL)
    scene = Scene([*street.scene.solids, car], street.scene.terrain)
    (scan,) = simulate(scene, street.sensor, T[None], name="car", seed=i).points
    of_street = -(scan / np.linalg.norm(scan, axis=1, keepdims=True)) @ (T[:3, :3].T @ velocity[i])
    on_car = (np.abs(scan - car_sensor) < half_m + 0.3).all(axis=1)
    points.append(scan)
    doppler_mps.append(np.where(on_car, 0.0, of_street) + rng.normal(0, 0.1, len(scan)))

# %%
# A driver calls ``integrate``; another thread reads the map meanwhile. It never sees a part of a scan. The poses drift.

given = radarsdf.simulate.drifted(street.poses, 0.02, 0.002)
naive, live = radarsdf.LiveMap(), radarsdf.LiveMap()
done = threading.Event()


def watch():
    """Mesh the map repeatedly, as a planner does."""
    while not done.wait(0.5):
        print(f"{len(live.mesh().faces)} triangles of {len(live)} scans")


watcher = threading.Thread(target=watch)
watcher.start()
moving = 0
for scan, pose, speeds in zip(points, given, doppler_mps, strict=True):
    naive.integrate(scan, pose)
    moving += live.integrate(scan, pose, doppler_mps=speeds).moving
done.set()
watcher.join()
print(f"{moving} returns of the car were left out")

# %%
# A loop closure moves all scans to refined poses at once.

refined = radarsdf.refine_poses(points, given, doppler_mps=doppler_mps, times_s=0.1 * np.arange(len(given)))
blocks = live.move_all(dict(zip(live.scan_ids, refined.poses, strict=True)))
print(f"{len(blocks)} blocks changed: {refined.report['verdict']}")

# %%
figure, rows = plt.subplots(2, 1, figsize=(9, 8), layout="constrained")
for axes, shown, title in (
    (rows[0], naive, "poses that drift, without Doppler: the car leaves a trail"),
    (rows[1], live, "refined poses, with Doppler"),
):
    axes.imshow(render(shown.mesh(), width=720, height=320))
    axes.set_title(title)
    axes.axis("off")
plt.show()
