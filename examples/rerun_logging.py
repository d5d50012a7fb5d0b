"""Log scans, poses and the map to the rerun viewer. Requires the extra `rerun`.

python examples/rerun_logging.py [FOLDER]      # then: rerun drive.rrd
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf
import rerun as rr
from radarsdf.map.colors import intensity_colors


def main(folder: Path) -> None:
    """Log a drive scan by scan, and the mesh fitted to it."""
    drive = radarsdf.simulate.hugin(frames=12)
    radar_map = radarsdf.fit(drive.points, drive.poses, drive.intensities)
    mesh = radar_map.mesh(0.2, viewpoint=drive.poses[0, :3, 3])

    rr.init("radarsdf")
    rr.save(folder / "drive.rrd")
    rr.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    low, high = np.percentile(np.concatenate(drive.intensities), [1, 99])
    for i, (points, values) in enumerate(zip(drive.points, drive.intensities, strict=True)):
        rr.set_time("scan", sequence=i)
        T_world_sensor = drive.poses[i]
        rr.log(
            "world/sensor", rr.Transform3D(translation=T_world_sensor[:3, 3], mat3x3=T_world_sensor[:3, :3])
        )
        colors = intensity_colors(values, low, high)
        rr.log("world/sensor/returns", rr.Points3D(points, colors=colors, radii=0.05))
        rr.log("intensity/mean", rr.Scalars(values.mean()))
    rr.log(
        "world/map",
        rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_colors=mesh.visual.vertex_colors,
            vertex_normals=mesh.vertex_normals,
        ),
        static=True,
    )
    rr.disconnect()
    print(f"{len(drive)} scans and {len(mesh.faces)} triangles logged to {folder / 'drive.rrd'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
