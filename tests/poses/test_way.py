# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a map keeps of refined or found poses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from radarsdf import Odometry, RefinedPoses
from radarsdf.map.storage import checked_report
from radarsdf.poses.way import pose_sigmas, way_of


def refined(scans):
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, 0, 3] = np.arange(scans)
    covariance = np.tile(np.diag([1.0, 4, 4, 0.01, 0.01, 0.04]), (scans, 1, 1))
    return RefinedPoses(poses, covariance, True, {"verdict": "Better.", "sigma_m": 0.1, "sigma_rad": 0.02})


def test_deviations_are_those_of_the_covariance():
    np.testing.assert_allclose(pose_sigmas(refined(3).covariance), [np.sqrt(3), np.sqrt(0.02)])


def test_it_is_kept_with_the_map():
    found = refined(1201)
    given = found.poses + 0.0
    given[:, 1, 3] = 1
    way = json.loads(json.dumps(way_of(found, given)))
    assert len(way["scans"]) == len(way["before"]) == len(way["after"]) == len(way["sigma_m"]) == 500
    assert way["after"][-1] == [1200, 0, 0]
    assert way["before"][-1] == [1200, 1, 0]
    assert (way["verdict"], way["improved"], way["step_m"]) == ("Better.", True, 0.1)
    assert checked_report({"poses": way})["poses"] == way
    with pytest.raises(ValueError, match=r"report\.poses"):
        checked_report({"poses": way | {"sigma_m": ["wide"]}})


def test_of_poses_that_were_found_only_a_piece_is_kept():
    of = refined(4)
    found = Odometry(of.poses, of.covariance, np.array([0, 0, 0, 1]), np.ones(4), {"verdict": "Found."})
    way = way_of(found, None, found.longest_piece())
    assert (way["before"], way["improved"], len(way["after"])) == (None, None, 3)
