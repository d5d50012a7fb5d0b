"""Read a folder of point clouds with a pose file, check and fit it.

    python examples/folder.py [FOLDER]

On the command line: radarsdf check drive poses.tum; radarsdf fit drive poses.tum -o map.safetensors.
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf
from scipy.spatial.transform import Rotation


def record(folder: Path) -> tuple[Path, Path]:
    """Write a recording: one PCD file for each scan, named by its time, and poses in TUM format."""
    drive = radarsdf.simulate.hugin(frames=12)
    clouds = folder / "drive"
    clouds.mkdir(exist_ok=True)
    lines = []
    for i, (points, values) in enumerate(zip(drive.points, drive.intensities, strict=True)):
        time_s, T_world_sensor = 1_700_000_000.0 + 0.1 * i, drive.poses[i]
        header = (
            f"VERSION .7\nFIELDS x y z power\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(points)}\n"
            f"HEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
        )
        columns = np.column_stack([points, values]).astype(np.float32)
        (clouds / f"{time_s:.6f}.pcd").write_bytes(header.encode() + columns.tobytes())
        quaternion = Rotation.from_matrix(T_world_sensor[:3, :3]).as_quat()
        lines.append(" ".join(f"{x:.9f}" for x in [time_s, *T_world_sensor[:3, 3], *quaternion]))
    poses = folder / "poses.tum"
    poses.write_text("\n".join(lines) + "\n")
    return clouds, poses


def main(folder: Path) -> None:
    """Read, check and fit the recording."""
    clouds, poses = record(folder)
    scans = radarsdf.io.read(clouds, poses)  # fields={"intensity": "power"} for unusual names
    for note in scans.notes:  # assumptions, and what was skipped
        print(note)
    print(f"{len(scans)} scans from {scans.times_s[0]:.1f} to {scans.times_s[-1]:.1f} s")
    errors = [finding for finding in radarsdf.check(scans) if finding.severity == "error"]
    if errors:
        raise SystemExit("\n".join(map(str, errors)))
    radar_map = radarsdf.fit(scans)
    print(radar_map)
    radar_map.save(folder / "map.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
