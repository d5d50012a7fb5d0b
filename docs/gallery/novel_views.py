"""
Predict a scan
==============

Predict the scan that the radar would measure from another pose, and compare it with one that the fit did not use.
"""

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from scipy.spatial import cKDTree

HELD_OUT = 10

drive = radarsdf.simulate.hugin(frames=20)
kept = [i for i in range(len(drive)) if i != HELD_OUT]
radar_map = radarsdf.fit(
    [drive.points[i] for i in kept], drive.poses[kept], [drive.intensities[i] for i in kept]
)

# %%
# The field of view, the beam width, the number of returns and the detection threshold are those of the radar, which the
# fit estimates.

view = radar_map.render(drive.poses[HELD_OUT])
measured, measured_db = drive.points[HELD_OUT], drive.intensities[HELD_OUT]
distance_m, nearest = cKDTree(view.points).query(measured)
error_db = np.abs(view.intensities[nearest] - measured_db)
print(f"{len(view)} returns predicted, {len(measured)} measured")
print(f"medians: distance {np.median(distance_m):.2f} m, intensity error {np.median(error_db):.1f} dB")

# %%
# A view also holds the range to the first surface along each beam.

figure, axes = plt.subplots(3, 1, figsize=(9, 9), sharex=True, layout="constrained")
low, high = np.percentile(measured_db, [2, 98])
for row, points, values, title in (
    (axes[0], measured, measured_db, "measured"),
    (axes[1], view.points, view.intensities, "predicted"),
):
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    range_m = np.linalg.norm(points, axis=1)
    shown = row.scatter(azimuth_deg, range_m, c=values, s=4, vmin=low, vmax=high)
    row.set(title=title, ylabel="range, m", ylim=(0, 60))
    figure.colorbar(shown, label="intensity, dB")
shown = axes[2].pcolormesh(
    np.degrees(view.azimuth_rad), np.degrees(view.elevation_rad), view.beam_ranges_m, cmap="magma"
)
axes[2].set(title="first surface", xlabel="azimuth, degrees", ylabel="elevation, degrees")
axes[2].invert_xaxis()  # left is left
figure.colorbar(shown, label="range, m")
plt.show()
