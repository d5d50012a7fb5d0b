# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Your own arrays: scans, poses and intensities in, a mesh, distances and predicted intensities out.

python examples/numpy_arrays.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf


def my_scans() -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """Put your own data here. A simulated drive stands for it.

    Returns
    -------
    points : F arrays (N_i, 3), sensor frame, m
    poses : (F, 4, 4), T_world_sensor, m
    intensities : F arrays (N_i,), sensor units, here dB
    """
    drive = radarsdf.simulate.hugin(frames=12)
    return drive.points, drive.poses, drive.intensities


def main(folder: Path) -> None:
    """Fit, ask, and write what a viewer of meshes shows."""
    points, poses, intensities = my_scans()
    for finding in radarsdf.check(points, poses, intensities):  # frames, units, clocks; empty is best
        print(finding)

    radar_map = radarsdf.fit(points, poses, intensities)
    print(radar_map)

    mesh = radar_map.mesh(voxel_size=0.2, viewpoint=poses[0, :3, 3])
    at = np.stack([mesh.vertices[0] + 0.1 * mesh.vertex_normals[0], poses[0, :3, 3]])  # world, m
    near, at_sensor = radar_map.sdf(at)
    print(f"signed distance {near:.2f} m before the surface, positive in free space")
    print(f"{at_sensor} m at the sensor: no return is near")

    dB = mesh.vertex_attributes["intensity"]
    print(f"{len(mesh.faces)} triangles; intensities from the first pose {dB.min():.0f} to {dB.max():.0f} dB")
    radarsdf.io.write_mesh(folder / "mesh.ply", mesh)
    radar_map.save(folder / "map.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
