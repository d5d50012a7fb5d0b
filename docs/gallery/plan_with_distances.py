"""
Distances for a planner
=======================

A grid of occupied, free and unknown voxels, its Euclidean distance field (ESDF), and the clearance of a path.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from matplotlib.colors import ListedColormap

drive = radarsdf.simulate.hugin(frames=30)
radar_map = radarsdf.fit(drive.points, drive.poses)
at = drive.poses[15, :3, 3]
grid = radarsdf.grid(radar_map, [at - [12, 12, 3], at + [12, 12, 3]], voxel_size=0.2)

# %%
# The map lacks a parked car, which is known: it is stamped in. ``at`` interpolates distances and gradients.

car = [at + [4.0, 1.0, -1.5], at + [8.0, 3.0, 0.0]]
field = grid.distances(obstacles=[car])
path = at + np.linspace(-10, 10, 41)[:, None] * [1.0, 0.15, 0.0] + [0.0, 4.0, -0.3]
distance_m, gradient = field.at(path)
nearest = np.nanargmin(distance_m)
print(f"narrowest at {path[nearest, 0]:.1f}, {path[nearest, 1]:.1f}: {distance_m[nearest]:.2f} m")
print(
    f"± {field.error_m:.2f} m; {np.isnan(distance_m).sum()} of {len(path)} positions are unknown: treat as occupied"
)

# %%
# A slice through grid and distances at the height of the path. Arrows point away from the nearest obstacle.

layer = int((path[0, 2] - grid.origin[2]) / grid.voxel_size)
kinds = 1 * grid.free[..., layer] + 2 * grid.occupied[..., layer]
x, y = (grid.origin[i] + grid.voxel_size * np.arange(kinds.shape[i] + 1) for i in (0, 1))
xyz = np.stack([*np.meshgrid(x[:-1] + 0.1, y[:-1] + 0.1), np.full(kinds.T.shape, path[0, 2])], -1)
slice_m = field.at(xyz.reshape(-1, 3))[0].reshape(kinds.T.shape)
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5.5), sharey=True, layout="constrained")
left.pcolormesh(x, y, kinds.T, cmap=ListedColormap(["0.8", "white", "black"]))
left.set_title("white: free, black: occupied, grey: unknown")
shown = right.pcolormesh(x, y, slice_m, cmap="viridis", vmin=0, vmax=3)
right.quiver(*path[::3, :2].T, *gradient[::3, :2].T, color="tab:red", width=0.004)
right.set_facecolor("0.8")
right.set_title("distance to the nearest surface or obstacle")
for axes in (left, right):
    axes.plot(path[:, 0], path[:, 1], color="tab:red", label="path")
    axes.set(aspect="equal", xlabel="x, m")
left.set_ylabel("y, m")
left.legend()
figure.colorbar(shown, label="m")
plt.show()
