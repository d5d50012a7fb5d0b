"""Errors of a trajectory against the true one, by the definitions of evo and KITTI."""

from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import ArrayLike, Floats
from radarsdf.checks import check, check_poses, real_array
from radarsdf.poses.rigid import aligned, between, nearest_rotation, placed, steps, turned_by

Alignment = Literal["positions", "poses", "none"]

_SHARES = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # segment lengths of short trajectories
_KITTI_M = np.arange(100.0, 900.0, 100.0)


def trajectory_metrics(
    poses: ArrayLike, true_poses: ArrayLike, *, align: Alignment = "positions"
) -> dict[str, Any]:
    """Compute the errors of a trajectory against the true one.

    Parameters
    ----------
    poses, true_poses : (F, 4, 4) array_like
        T_world_sensor, m, of the same scans. Their worlds may differ.
    align : {"positions", "poses", "none"}
        Rigid alignment of the whole: of all positions (Umeyama 1991, as ``evo_ape --align``), of
        mean position and mean rotation, or none. Positions on a straight line leave the rotation about it open;
        "poses" does not.

    Returns
    -------
    dict of str to float
        ``absolute_m`` and ``absolute_rad``, root mean square over the scans; ``step_m`` and ``step_rad``, root mean square
        of the motion between consecutive scans; ``relative_ratio`` and ``relative_rad_per_m``, mean error over length of the
        segments that begin at each scan: those of KITTI, 100 to 800 m, or of a trajectory shorter than 800 m, 10, 20, 30, 40
        and 50 % of its length; ``length_m`` of the true trajectory.

    Raises
    ------
    ValueError
        If poses are not rigid transforms, their numbers differ, or `align` is none of these.

    Notes
    -----
    Verified against evo 1.38: ``evo_ape --align`` and ``evo_rpe --delta 1 --delta_unit f``, of positions and of angles.

    Examples
    --------
    >>> import numpy as np
    >>> from radarsdf.evaluation import trajectory_metrics
    >>> true = np.tile(np.eye(4), (11, 1, 1))
    >>> true[:, 0, 3] = np.arange(11.0)
    >>> stretched = true.copy()
    >>> stretched[:, 0, 3] *= 1.02
    >>> metrics = trajectory_metrics(stretched, true)
    >>> round(metrics["relative_ratio"], 3), round(metrics["step_m"], 3)
    (0.02, 0.02)
    """
    fits = align in get_args(Alignment)
    check(fits, f"align must be one of {', '.join(get_args(Alignment))}, not {align!r:.50}")
    true = check_poses(real_array(true_poses, "true_poses"))
    found = check_poses(poses, len(true))
    at = aligned(found, true) if align == "poses" else found
    if align == "positions":
        from_middle, from_middle_true = (x[:, :3, 3] - x[:, :3, 3].mean(axis=0) for x in (found, true))
        at = placed(nearest_rotation(np.einsum("fi,fj->ij", from_middle_true, from_middle)), found, true)
    true_steps = steps(true)
    off = between(true_steps, steps(found))
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(true_steps[:, :3, 3], axis=1))])
    ratio, rad_per_m = _relative(found, true, distance_m)
    return {
        "protocol": "radarsdf-trajectory-1",  # changes with the meaning of a number
        "align": align,
        "num_poses": len(true),
        "length_m": float(distance_m[-1]),
        "absolute_m": _rms(np.linalg.norm((at - true)[:, :3, 3], axis=1)),
        "absolute_rad": _rms(turned_by(at, true)),
        "step_m": _rms(np.linalg.norm(off[:, :3, 3], axis=1)),
        "step_rad": _rms(_angles(off)),
        "relative_ratio": ratio,
        "relative_rad_per_m": rad_per_m,
    }


def _relative(poses: Floats, true: Floats, distance_m: Floats) -> tuple[float | None, float | None]:
    """Mean errors of translation, m/m, and rotation, rad/m, of all segments."""
    lengths = _KITTI_M if distance_m[-1] >= _KITTI_M[-1] else distance_m[-1] * _SHARES
    ratios, angles = [np.zeros(0)], [np.zeros(0)]
    for length in lengths[lengths > 0]:
        last = np.searchsorted(distance_m, distance_m + length)
        first = np.flatnonzero(last < len(distance_m))
        last = last[first]
        off = between(between(true[first], true[last]), between(poses[first], poses[last]))
        ratios.append(np.linalg.norm(off[:, :3, 3], axis=1) / length)
        angles.append(_angles(off) / length)
    ratio, angle = np.concatenate(ratios), np.concatenate(angles)
    return (float(ratio.mean()), float(angle.mean())) if len(ratio) else (None, None)


def _angles(motions: Floats) -> Floats:
    return Rotation.from_matrix(motions[:, :3, :3]).magnitude() if len(motions) else np.zeros(0)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
