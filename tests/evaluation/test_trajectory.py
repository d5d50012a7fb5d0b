# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Errors of trajectories: against known ones, and against evo where it is installed."""

import numpy as np
import pytest
from radarsdf.evaluation import trajectory_metrics
from radarsdf.poses.rigid import moved
from radarsdf.simulate import drifted

from ..poses.drift import trajectory

WHOLE = moved(np.eye(4)[None], np.array([[30.0, -20, 10, 0.4, -0.3, 2.1]]))[0]


def test_the_same_trajectory_in_another_frame_has_no_error():
    true = trajectory(50)
    for align in ("positions", "poses"):
        metrics = trajectory_metrics(WHOLE @ true, true, align=align)
        for name in (
            "absolute_m",
            "absolute_rad",
            "step_m",
            "step_rad",
            "relative_ratio",
            "relative_rad_per_m",
        ):
            assert metrics[name] == pytest.approx(0, abs=1e-6), (align, name)
    assert trajectory_metrics(WHOLE @ true, true, align="none")["absolute_m"] > 10


def test_a_turn_that_is_too_sharp_has_the_error_of_its_length():
    true = np.tile(np.eye(4), (101, 1, 1))
    true[:, 0, 3] = np.arange(101)
    found = drifted(true, 0, 0, 0, yaw_rad=0.001)
    metrics = trajectory_metrics(found, true, align="none")
    assert metrics["step_rad"] == pytest.approx(0.001)
    assert metrics["step_m"] == pytest.approx(0, abs=1e-9)
    assert metrics["relative_rad_per_m"] == pytest.approx(0.001)
    # The sides of an arc: half of its angle, so 5 to 25 thousandths of 10 to 50 m; there are 91 to 51 of each.
    counts, angles = np.arange(91, 50, -10), 0.001 * np.arange(10, 51, 10) / 2 - 0.0005
    assert metrics["relative_ratio"] == pytest.approx(counts @ angles / counts.sum(), rel=0.02)
    assert metrics["length_m"] == pytest.approx(100)


def test_segments_of_long_trajectories_are_those_of_kitti():
    true = np.tile(np.eye(4), (802, 1, 1))
    true[:, 0, 3] = np.arange(802)
    found = drifted(true, 0, 0, 0, yaw_rad=1e-5)
    counts, angles = 802 - np.arange(100, 801, 100), 1e-5 * np.arange(100, 801, 100) / 2
    ratio = trajectory_metrics(found, true, align="none")["relative_ratio"]
    assert ratio == pytest.approx(counts @ angles / counts.sum(), rel=0.01)


def test_one_pose_has_no_steps():
    metrics = trajectory_metrics(np.eye(4)[None], np.eye(4)[None])
    assert (metrics["step_m"], metrics["relative_ratio"], metrics["length_m"]) == (0, None, 0)


def test_wrong_arguments_are_refused():
    poses = trajectory(4)
    with pytest.raises(ValueError, match="align"):
        trajectory_metrics(poses, poses, align="scale")
    with pytest.raises(ValueError, match="poses"):
        trajectory_metrics(poses[:3], poses)


def test_they_are_those_of_evo():
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed: pip install evo")
    PoseTrajectory3D = pytest.importorskip("evo.core.trajectory").PoseTrajectory3D
    true = trajectory(200)
    found = WHOLE @ drifted(true, 0.03, 0.004, 7)
    stamps = np.arange(200.0)
    reference = PoseTrajectory3D(poses_se3=list(true), timestamps=stamps)
    raw, brought = (PoseTrajectory3D(poses_se3=list(found), timestamps=stamps) for _ in range(2))
    brought.align(reference)
    ours = trajectory_metrics(found, true)

    def of_evo(metric, estimate):
        metric.process_data((reference, estimate))
        return metric.get_statistic(metrics.StatisticsType.rmse)

    relations = (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad)
    for relation, absolute, step in zip(
        relations, ("absolute_m", "absolute_rad"), ("step_m", "step_rad"), strict=True
    ):
        assert ours[absolute] == pytest.approx(of_evo(metrics.APE(relation), brought), rel=1e-6)
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        assert ours[step] == pytest.approx(of_evo(rpe, raw), rel=1e-6)
