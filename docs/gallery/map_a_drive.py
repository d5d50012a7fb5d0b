"""
Map a drive
===========

Fit a map, and draw its surface, its uncertainty and its signed distance.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.render.picture import render

# %%
# Points are in the sensor frame, poses are ``T_world_sensor``, both in metres; intensities are in the sensor's unit.
# Replace the simulated drive by your arrays, or by ``radarsdf.io.read("drive.mcap")``.

drive = radarsdf.simulate.hugin(frames=20)
radar_map = radarsdf.fit(drive.points, drive.poses, drive.intensities)
mesh = radar_map.mesh(0.2, viewpoint=drive.poses[10, :3, 3])
print(radar_map)
print(f"{len(mesh.faces)} triangles")

# %%
# The mesh is coloured by the intensity that the radar would measure from ``viewpoint``; nearer than any return it is grey.
# ``radarsdf.io.write_mesh("mesh.ply", mesh)`` writes it.


def show(colors, title):
    """Draw the mesh with colours (V, 3) of its vertices."""
    figure, axes = plt.subplots(figsize=(10, 4.7), layout="constrained")
    axes.imshow(render(mesh, colors, width=720, height=320))
    axes.set_title(title)
    axes.axis("off")
    return figure, axes


show(mesh.visual.vertex_colors, "intensity from the middle of the drive")

# %%
# The standard error of the surface grows with range and shrinks with the number of returns.

uncertainty_m = mesh.vertex_attributes["uncertainty_m"]
shades = plt.cm.ScalarMappable(plt.Normalize(*np.percentile(uncertainty_m, [2, 98])), "viridis")
figure, axes = show(shades.to_rgba(uncertainty_m, bytes=True), "uncertainty of the surface")
figure.colorbar(shades, ax=axes, label="standard error, m", shrink=0.7)

# %%
# The signed distance at the height of the sensor: blue in free space, red behind surfaces, white where nothing was
# observed and the map returns NaN. Arrows are its gradient.

x, y = np.arange(28, 44, 0.05), np.arange(-12, -4, 0.05)
slice_xyz = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), drive.poses[0, 2, 3])], -1)
sdf_m, gradient = radar_map.sdf(slice_xyz.reshape(-1, 3), return_gradient=True)
sdf_m, gradient = sdf_m.reshape(len(y), len(x)), gradient.reshape(len(y), len(x), 3)
figure, axes = plt.subplots(figsize=(10, 5), layout="constrained")
shown = axes.pcolormesh(x, y, sdf_m, cmap="RdBu", vmin=-0.4, vmax=0.4)
axes.contour(x, y, sdf_m, [0.0], colors="black", linewidths=1.0)
every = 8
at, along = slice_xyz[::every, ::every], gradient[::every, ::every]
axes.quiver(at[..., 0], at[..., 1], along[..., 0], along[..., 1], scale=40, width=0.0015)
axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
figure.colorbar(shown, label="signed distance, m", shrink=0.7)
plt.show()
