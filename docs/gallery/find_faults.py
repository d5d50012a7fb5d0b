"""
Find faults in a recording
==========================

``check`` finds mistakes in frames, units and clocks before they become a wrong map.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from scipy.spatial.transform import Rotation

drive = radarsdf.simulate.oculii(seed=5, frames=36)
turned = drive.poses.copy()
turned[:, :3, :3] = turned[:, :3, :3] @ Rotation.from_euler("z", 15, degrees=True).as_matrix()
recordings = {
    "as recorded": (drive.points, drive.poses),
    "poses inverted": (drive.points, np.linalg.inv(drive.poses)),
    "radar mounted 15 degrees to the left": (drive.points, turned),
}

# %%
# A finding has a severity, a name, and a message with evidence and remedy. ``radarsdf fit`` stops at an error.

figure, grid = plt.subplots(1, 3, figsize=(12, 4.5), layout="constrained")
for axes, (title, (points, poses)) in zip(grid, recordings.items(), strict=True):
    worst = [found for found in radarsdf.check(points, poses) if found.severity == "error"]
    print(f"{title}:", *worst or ["no error"], sep="\n  ")
    world = np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(points, poses, strict=True)])
    axes.plot(world[:, 0], world[:, 1], ",", color="black")
    axes.set_title(f"{title}\n{', '.join(found.name for found in worst) or 'no error'}")
    axes.set(aspect="equal", xlim=(-40, 40), ylim=(-40, 40))
plt.show()
