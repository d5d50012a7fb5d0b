"""
Detect changes between two days
===============================

One box disappears, another one appears; everything else is the same, up to noise.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.changes.changes import COLORS, NAMES
from radarsdf.render.picture import render
from radarsdf.simulate import Box, Scene, simulate
from radarsdf.simulate.materials import CONCRETE

# %%
# Two drives past a wall. Maps that are compared need free-space crossings, which quick fits leave out by default: rays
# through the place show that a surface is gone.

first = radarsdf.simulate.wall(frames=24)
second_poses = first.poses.copy()
second_poses[:, 1, 3] += 0.3
config = radarsdf.FitConfig.quick(returns={"free_space": True})
maps = []
for day, (poses, center) in enumerate(((first.poses, [2.5, 2.5, 0.5]), (second_poses, [2.5, -3.0, 0.5]))):
    box = Box(np.array(center), np.full(3, 0.5), 0.0, CONCRETE)
    scene = Scene([*first.scene.solids, box], first.scene.terrain)
    drive = simulate(scene, first.sensor, poses, name="wall", seed=day)
    maps.append(radarsdf.fit(drive.points, drive.poses, config=config))

# %%
changes = radarsdf.compare(*maps, box=[[-3.0, -6.0, -0.5], [12.0, 6.0, 3.0]])
print(changes.report["alignment"])
for region in changes.regions()[:2]:
    print(region)

# %%
mesh = changes.mesh()
figure, axes = plt.subplots(figsize=(10, 4.7), layout="constrained")
axes.imshow(render(mesh, mesh.visual.vertex_colors, width=720, height=320))
axes.axis("off")
for kind, name in NAMES.items():
    axes.plot([], [], "s", color=np.array(COLORS[kind]) / 255, label=name)
axes.legend(loc="upper left")
plt.show()
