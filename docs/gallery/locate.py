"""
Localise in yesterday's map
===========================

Find scans without poses in a map that was made before.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.simulate import hugin, measured_motion, simulate

# %%
# On the second day the radar drives the same street 0.8 m to the side. Its scans have Doppler and times.

first = hugin(frames=36)
radar_map = radarsdf.fit(first.points, first.poses, config=radarsdf.FitConfig.quick())
poses = first.poses[6:26].copy()
poses[:, 1, 3] += 0.8
later = simulate(first.scene, first.sensor, poses, name="later", seed=1)
motion = measured_motion(later)
found = radarsdf.locate(radar_map, later.points, doppler_mps=motion.doppler_mps, times_s=motion.times_s)
print(found.report["verdict"])
print(f"error {np.linalg.norm(found.poses[:, :3, 3] - poses[:, :3, 3], axis=1).max():.2f} m at most")
print(f"{np.nanmedian(found.explained):.0%} of the returns are on surfaces of the map")

# %%
figure, axes = plt.subplots(figsize=(11, 5.5), layout="constrained")
world = np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(later.points, found.poses, strict=True)])
for xyz, color, label in (
    (radar_map.mesh(0.2).vertices, "0.6", "map"),
    (world, "tab:orange", "returns of the second day"),
):
    high = xyz[xyz[:, 2] > 1.0]  # above the ground
    axes.plot(high[:, 0], high[:, 1], ".", ms=2, color=color, label=label)
axes.plot(first.poses[:, 0, 3], first.poses[:, 1, 3], color="black", label="first day")
axes.plot(poses[:, 0, 3], poses[:, 1, 3], color="tab:green", lw=6, label="second day, true")
axes.plot(found.poses[:, 0, 3], found.poses[:, 1, 3], color="tab:red", lw=2, label="second day, found")
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
axes.legend(markerscale=4)
plt.show()
