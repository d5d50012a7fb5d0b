"""Predict a scan from another pose, and compare a predicted scan with a held-out one.

    python examples/novel_views.py [FOLDER]

Requires the extra `plot`. On the command line: radarsdf render map.safetensors --pose 5 0 1.5 -o view.png.
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf
from radarsdf.render.figures import save_view_picture
from scipy.spatial import cKDTree

HELD_OUT = 10


def main(folder: Path) -> None:
    """Hold out a scan, predict it, and predict another one turned by 30 degrees."""
    drive = radarsdf.simulate.hugin(frames=20)
    kept = [i for i in range(len(drive)) if i != HELD_OUT]
    radar_map = radarsdf.fit(
        [drive.points[i] for i in kept], drive.poses[kept], [drive.intensities[i] for i in kept]
    )

    T_world_sensor = drive.poses[HELD_OUT]
    view = radar_map.render(T_world_sensor)
    distance_m, nearest = cKDTree(view.points).query(drive.points[HELD_OUT])
    error_db = np.abs(view.intensities[nearest] - drive.intensities[HELD_OUT])
    print(f"{len(view)} returns predicted, {len(drive.points[HELD_OUT])} measured")
    print(
        f"median distance {np.median(distance_m):.2f} m, median intensity error {np.median(error_db):.1f} dB"
    )
    measured = np.column_stack([drive.points[HELD_OUT], drive.intensities[HELD_OUT]])
    save_view_picture(folder / "view.png", [view], [measured])

    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    aside = T_world_sensor @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    returns = radar_map.render(aside, noise=True, seed=1)
    radarsdf.io.write_cloud(folder / "aside.ply", returns.scans)  # world frame
    print(f"wrote {len(returns)} returns, turned by 30 degrees, to aside.ply")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
