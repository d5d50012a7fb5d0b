"""Write the files that the pages use, from a short simulated drive."""

from pathlib import Path

import numpy as np
import radarsdf
from scipy.spatial.transform import Rotation

START_S = 1717252210.0
_STEP_S = 0.1
_FRAMES = 8


def write_recordings(folder: Path) -> None:
    """Write a drive as a PCD folder, in KITTI format in millimetres, and as a ROS 2 bag, complete and truncated."""
    drive = radarsdf.simulate.hugin(frames=_FRAMES)
    _pcd(folder / "drive", drive)
    _tum(folder / "drive.tum", drive.poses)
    _bag(folder / "drive_mcap", drive)
    _cut_off(folder / "drive_mcap", folder / "cut_mcap")


def _pcd(folder, drive):
    folder.mkdir()
    for i, (points, values) in enumerate(zip(drive.points, drive.intensities, strict=True)):
        n = len(points)
        header = (
            f"VERSION .7\nFIELDS x y z power\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
            f"POINTS {n}\nDATA binary\n"
        )
        columns = np.column_stack([points, values]).astype("<f4")
        name = f"{START_S + i * _STEP_S:.6f}.pcd"
        (folder / name).write_bytes(header.encode() + columns.tobytes())


def _tum(path, poses):
    rows = [
        [START_S + i * _STEP_S, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        for i, pose in enumerate(poses)
    ]
    path.write_text("\n".join(" ".join(f"{x:.9f}" for x in row) for row in rows) + "\n", encoding="utf-8")


def _bag(path, drive):
    from tests.io.bag_writing import BagWriter  # noqa: PLC0415 - it needs rosbags, an extra

    T_base_radar = np.eye(4)
    T_base_radar[:3, 3] = [1.0, 0.0, 0.5]
    with BagWriter(path, "mcap") as bag:
        bag.write("/tf_static", bag.transforms(START_S, {("base_link", "radar"): T_base_radar}), START_S)
        for i, (points, values) in enumerate(zip(drive.points, drive.intensities, strict=True)):
            now = START_S + i * _STEP_S
            T_odom_base = drive.poses[i] @ np.linalg.inv(T_base_radar)
            bag.write("/tf", bag.transforms(now, {("odom", "base_link"): T_odom_base}), now)
            x, y, z = points.T
            bag.write("/radar/points", bag.cloud2(now, {"x": x, "y": y, "z": z, "power": values}), now)


def _cut_off(bag, cut):
    """Copy a bag and truncate its recording."""
    cut.mkdir()
    for file in bag.iterdir():
        data = file.read_bytes()
        (cut / file.name).write_bytes(data if file.suffix == ".yaml" else data[: len(data) * 2 // 3])
