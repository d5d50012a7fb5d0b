"""
Calibrate several radars
========================

Estimate how the radars of a rig are mounted from a drive, and map with all of them.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.simulate import MountedRadar, oculii, simulate_rig
from scipy.spatial.transform import Rotation

# %%
# A second radar looks to the left. Its mounting is known to 6 degrees and 0.1 m.

drive = oculii(seed=5, frames=48)
true = np.eye(4)
true[:3, :3], true[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [-0.5, 0.4, 0.1]
rough = true.copy()
rough[:3, :3] = true[:3, :3] @ Rotation.from_euler("zy", [6, 2], degrees=True).as_matrix()
rough[:3, 3] += 0.1
radars = {"front": MountedRadar(drive.sensor, np.eye(4)), "left": MountedRadar(drive.sensor, true)}
rig = simulate_rig(drive.scene, radars, drive.poses, 0.1 * np.arange(48)).scans


def scans(mounting):
    """The recording, with a mounting (4, 4) of the left radar."""
    return radarsdf.io.Scans(
        rig.points,
        rig.poses,
        rig.intensities,
        doppler_mps=rig.doppler_mps,
        times_s=rig.times_s,
        sensors=rig.sensors,
        T_body_sensor={"front": np.eye(4), "left": mounting},
    )


# %%
left = radarsdf.calibrate(scans(rough)).mountings["left"]
for name, mounting in (("rough", rough), ("calibrated", left.T_body_sensor)):
    turned = Rotation.from_matrix(mounting[:3, :3].T @ true[:3, :3]).magnitude()
    off = np.linalg.norm(mounting[:3, 3] - true[:3, 3])
    print(f"{name}: errors of {np.degrees(turned):.2f} degrees and {off:.3f} m")
print("standard deviations:", np.sqrt(left.covariance.diagonal()).round(4), "m, rad")

# %%
# Maps of both radars, from above: walls that are double or thick show a wrong mounting.

figure, panels = plt.subplots(1, 2, figsize=(12, 5), sharey=True, layout="constrained")
for axes, title, mounting in zip(panels, ("rough", "calibrated"), (rough, left.T_body_sensor), strict=True):
    recording = scans(mounting)
    for label, color in (("front", "tab:blue"), ("left", "tab:orange")):
        chosen = [i for i, sensor in enumerate(recording.sensors) if sensor == label]
        poses = recording.sensor_poses
        world = np.concatenate([recording.points[i] @ poses[i, :3, :3].T + poses[i, :3, 3] for i in chosen])
        high = world[world[:, 2] > 1.0]
        axes.plot(high[:, 0], high[:, 1], ".", ms=1, color=color, label=label)
    axes.set(title=title, aspect="equal", xlim=(-25, 25), ylim=(-20, 20), xlabel="x, m")
panels[0].set_ylabel("y, m")
panels[0].legend(markerscale=8)
plt.show()
