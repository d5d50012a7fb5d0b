# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf render``: from a map to the scans of poses never driven."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.map_in import add_map, load_map
from radarsdf.cli.options import add_json
from radarsdf.cli.results import Results, counted

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from radarsdf.map.view import View

_SUFFIXES = (".npz", ".ply", ".png")
_MAX_PICTURES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    parser.add_argument(
        "--pose",
        nargs="+",
        action="append",
        required=True,
        metavar="P",
        help="where the sensor is, world frame: x y z, m, or x y z qx qy qz qw, or a file of poses as for radarsdf fit; "
        "may be repeated",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        help="what to write: .npz, scans as radarsdf fit takes them; .ply, points in the world frame; .png, a picture",
    )
    parser.add_argument(
        "--returns",
        type=float,
        metavar="N",
        help="number of returns in a scan; default: what the sensor of the map gives",
    )
    parser.add_argument("--noise", action="store_true", help="add the noise of the sensor")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise; default: 0")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Predict the scans, and write them."""
    import numpy as np

    from radarsdf.budget.estimate import check_views
    from radarsdf.io.clouds.writing import write_cloud
    from radarsdf.io.files import check_outputs
    from radarsdf.io.npz import write_scans
    from radarsdf.map.view import scans_of_views
    from radarsdf.render.figures import save_view_picture

    suffix = options.out.suffix.lower()
    if suffix not in _SUFFIXES:
        msg = f"{options.out}: a view can be written as {', '.join(_SUFFIXES)}"
        raise ValueError(msg)
    if options.seed < 0:
        msg = f"--seed must be at least 0, not {options.seed}"
        raise ValueError(msg)
    poses = np.concatenate([_poses(words) for words in options.pose])
    if suffix == ".png" and len(poses) > _MAX_PICTURES:
        msg = f"a picture holds at most {_MAX_PICTURES} poses, not {len(poses)}: write .npz"
        raise ValueError(msg)
    check_outputs([options.out], [options.map])
    radar_map = load_map(options.map)
    rng = np.random.default_rng(options.seed)
    wanted = radar_map.sensor.returns_per_scan if options.returns is None else options.returns
    cells = radar_map.num_cells  # about as many as there are patches, which have one return at most
    check_views(None, returns=len(poses) * min(wanted, cells))
    views: Iterable[View] = (
        radar_map.render(pose, returns=options.returns, noise=options.noise, seed=rng) for pose in poses
    )
    if suffix == ".png":
        views = list(views)  # a picture shows all of a view; of others, the returns are kept alone
    scans = scans_of_views(view for view in views if len(view))
    if not len(scans):
        msg = f"{options.map} has no surface that the sensor sees from {'this pose' if len(poses) == 1 else 'these poses'}: nothing written"
        raise ValueError(msg)
    if suffix == ".npz":
        write_scans(options.out, scans)
    elif suffix == ".ply":
        write_cloud(options.out, scans)
    else:
        save_view_picture(options.out, list(views))
    empty = f", {len(poses) - len(scans)} of them without any" if len(scans) < len(poses) else ""
    results = Results(options)
    count = sum(map(len, scans.points))
    results.add(
        f"{count} returns of {counted(len(poses), 'scan')} written to {options.out}{empty}",
        returns=count,
        scans=len(poses),
        scans_without_returns=len(poses) - len(scans),
        out=options.out,
    )
    results.end()


def _poses(words: list[str]) -> NDArray[np.float64]:
    """T_world_sensor (F, 4, 4) of one option: numbers, or the name of a file."""
    import numpy as np

    numbers = _numbers(words)
    if numbers is None and len(words) == 1:
        return _poses_of_file(Path(words[0]))
    if numbers is None or len(numbers) not in (3, 7):
        msg = f"--pose takes x y z, x y z qx qy qz qw, or a file, not {' '.join(words)!r:.60}"
        raise ValueError(msg)
    pose = np.eye(4)
    pose[:3, 3] = numbers[:3]
    if len(numbers) == 7:
        pose[:3, :3] = _rotation(numbers[3:])
    return pose[None]


def _numbers(words: list[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _rotation(quaternion: list[float]) -> Any:
    import numpy as np
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < 0.01:
        msg = f"the quaternion of --pose, qx qy qz qw, must have length 1, not {length:.3g}"
        raise ValueError(msg)
    return Rotation.from_quat(quaternion).as_matrix()


def _poses_of_file(path: Path) -> NDArray[np.float64]:
    import numpy as np

    from radarsdf.io.poses.files import read_poses
    from radarsdf.io.poses.trajectory import Trajectory
    from radarsdf.io.scans import Notes

    found = read_poses(path, Notes(str(path)))
    if isinstance(found, Trajectory):
        return found.poses(found.times_s)
    assert not hasattr(found, "pose_at")  # files have no poses of another kind
    return found[np.isfinite(found).all(axis=(1, 2))]
