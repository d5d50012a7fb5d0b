"""Compute the clearance of a path from certain surfaces and from all possible ones.

    python examples/uncertainty_for_planning.py

A planner needs both: certain surfaces to localise and dock, possible ones to avoid collisions.
"""

import numpy as np
import radarsdf
import trimesh
from scipy.spatial import cKDTree

CERTAIN_M = 0.08  # standard error of the surface's position
PROBABLE = 0.8


def clearance(path: np.ndarray, mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance from each point of a path (N, 3) to a mesh, and the standard error of its surface, m."""
    centres = mesh.triangles_center
    distance_m, triangle = cKDTree(centres).query(path)
    vertices = mesh.faces[triangle]
    return distance_m, mesh.vertex_attributes["uncertainty_m"][vertices].max(axis=1)


def main() -> None:
    """Fit a drive, and check a path 3 m to the left of the sensor's trajectory."""
    drive = radarsdf.simulate.hugin(frames=20)
    radar_map = radarsdf.fit(drive.points, drive.poses)

    every = radar_map.mesh(0.2, max_uncertainty=np.inf, min_confidence=0, min_component_triangles=0)
    certain = radar_map.mesh(0.2, max_uncertainty=CERTAIN_M, min_confidence=PROBABLE)
    print(
        f"{every.area:.0f} m² of surface, {certain.area:.0f} m² within {CERTAIN_M} m and with {PROBABLE:.0%}"
    )

    path = drive.poses[:, :3, 3] + drive.poses[:, :3, 1] * 3.0  # the sensor's y axis points left
    to_any, error_any = clearance(path, every)
    to_certain, error_certain = clearance(path, certain)
    safe = np.maximum(to_any - 2 * error_any, 0)  # conservative by two standard errors
    print("  x     y    any surface, less 2σ   certain surface ± σ")
    for i in range(0, len(path), 4):
        x, y, _ = path[i]
        print(f"{x:5.1f} {y:5.1f} {safe[i]:15.2f} m {to_certain[i]:15.2f} ± {error_certain[i]:.2f} m")
    worst = int(safe.argmin())
    print(f"narrowest at {path[worst, 0]:.1f}, {path[worst, 1]:.1f}: {safe[worst]:.2f} m")


if __name__ == "__main__":
    main()
