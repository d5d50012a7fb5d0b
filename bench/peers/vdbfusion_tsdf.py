"""VDBFusion: the weighted average of truncated signed distances in a sparse grid (Vizzo et al., Sensors 2022)."""

import tempfile
from pathlib import Path

import numpy as np
from vdbfusion import VDBVolume

from .child import ScanArrays


def vdbfusion(scans: ScanArrays, voxel_m: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Mesh, and size in bytes of the file of the grids of distances and weights."""
    volume = VDBVolume(voxel_m, 3 * voxel_m, space_carving=False)  # truncation as in its own examples
    world = scans.world()
    for frame, T_world_sensor in enumerate(scans.poses):
        own = scans.frame == frame
        if own.any():
            volume.integrate(np.ascontiguousarray(world[own]), T_world_sensor)
    # With fill_holes, the border of the truncation band behind each surface becomes surface, too, and a third of the
    # mesh is outliers. Without, it is a stronger peer; we take the paper's "isolated vertex filtering" to mean this.
    vertices, faces = volume.extract_triangle_mesh(fill_holes=False, min_weight=0.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grids.vdb"
        volume.extract_vdb_grids(str(path))
        return vertices, faces, path.stat().st_size
