"""
Poses from the radar alone
==========================

Refine poses that drift, and estimate a trajectory where there are no poses.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.evaluation import trajectory_metrics

drive = radarsdf.simulate.oculii(seed=5, frames=50)
motion = radarsdf.simulate.measured_motion(drive)  # Doppler and times

# %%
# Poses as of wheel odometry, with errors of 0.05 m and 0.005 rad per step. ``refine_poses`` moves all scans until their
# returns lie on common surfaces.

given = radarsdf.simulate.drifted(drive.poses, 0.05, 0.005)
refined = radarsdf.refine_poses(drive.points, given)
print(refined.report["verdict"])

# %%
# ``odometry`` needs no poses: Doppler gives the velocity, matched returns the rotation. Its world is the frame of the
# first scan.

found = radarsdf.odometry(drive.points, doppler_mps=motion.doppler_mps, times_s=motion.times_s)
print(found.report["verdict"])

# %%
# Trajectories are moved to start at the true first pose.

figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
world = drive.world_points()[drive.is_surface()]
axes.plot(world[:, 0], world[:, 1], ",", color="0.7")
axes.plot(drive.poses[:, 0, 3], drive.poses[:, 1, 3], color="black", lw=4, label="true")
for label, poses, color in (
    ("drifting", given, "tab:red"),
    ("refined", refined.poses, "tab:green"),
    ("from the radar alone", found.poses, "tab:blue"),
):
    print(f"{label}: error of {trajectory_metrics(poses, drive.poses)['absolute_m']:.3f} m")
    placed = drive.poses[0] @ np.linalg.inv(poses[0]) @ poses
    axes.plot(placed[:, 0, 3], placed[:, 1, 3], color=color, label=label)
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m", xlim=(-16, 16), ylim=(-12, 12))
axes.legend()
plt.show()
