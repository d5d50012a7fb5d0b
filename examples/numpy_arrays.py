"""Fit a map to NumPy arrays, query it, and write a mesh.

python examples/numpy_arrays.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf


def my_scans() -> tuple[list[np.ndarray], np.ndarray, list[np.ndarray]]:
    """Return the scans to map. Replace the simulated drive by your data.

    Returns
    -------
    points : F arrays (N_i, 3), sensor frame, m
    poses : (F, 4, 4), T_world_sensor, m
    intensities : F arrays (N_i,), sensor units, here dB
    """
    drive = radarsdf.simulate.hugin(frames=12)
    return drive.points, drive.poses, drive.intensities


def main(folder: Path) -> None:
    """Check, fit, query, and write mesh and map to a folder."""
    points, poses, intensities = my_scans()
    for finding in radarsdf.check(points, poses, intensities):  # errors in frames, units or clocks
        print(finding)

    radar_map = radarsdf.fit(points, poses, intensities)
    print(radar_map)

    mesh = radar_map.mesh(voxel_size=0.2, viewpoint=poses[0, :3, 3])
    at = np.stack([mesh.vertices[0] + 0.1 * mesh.vertex_normals[0], poses[0, :3, 3]])  # world, m
    near, at_sensor = radar_map.sdf(at)
    print(f"signed distance 0.1 m before the surface: {near:.2f} m, positive in free space")
    print(f"signed distance at the sensor: {at_sensor} m, not observed")

    dB = mesh.vertex_attributes["intensity"]
    print(f"{len(mesh.faces)} triangles; intensities {dB.min():.0f} to {dB.max():.0f} dB from the first pose")
    radarsdf.io.write_mesh(folder / "mesh.ply", mesh)
    radar_map.save(folder / "map.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
