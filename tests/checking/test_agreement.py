"""Hypotheses move the scans as described, and the agreement of scans against a plain calculation."""

import re

import numpy as np
import pytest
from radarsdf.checking.frames import hypotheses
from radarsdf.poses.agreement import Agreement
from scipy.spatial.transform import Rotation

PAIRS = np.array([[0, 1], [1, 3]])
RNG = np.random.default_rng(0)
POSES = np.tile(np.eye(4), (5, 1, 1))
POSES[:, :3, :3] = Rotation.from_euler("ZYX", np.linspace([0.1, 0.0, 0.05], [1.2, 0.1, 0.0], 5)).as_matrix()
POSES[:, :3, 3] = RNG.uniform(-5, 5, (5, 3))


def motions(poses):
    return np.stack([np.linalg.inv(poses[j]) @ poses[i] for i, j in PAIRS])


def with_part(poses, part, values):
    changed = poses.copy()
    changed[:, :3, part] = values
    return changed


def read_as(words):
    """The (4, 4) matrix that maps x y z to axes such as "y, -x, z"."""
    found = np.eye(4)
    axes = dict(zip("xyz", np.eye(3), strict=True))
    found[:3, :3] = [-axes[word[1]] if word[0] == "-" else axes[word] for word in words.split(", ")]
    return found


def expected(what):
    """Motions under a hypothesis, from its description."""
    if words := re.fullmatch(r"the points are read as \((.*)\)", what):
        matrix = read_as(words[1])
        return np.linalg.inv(matrix) @ motions(POSES) @ matrix
    if words := re.fullmatch(r"the positions of the poses are read as \((.*)\)", what):
        return motions(with_part(POSES, 3, POSES[:, :3, 3] @ read_as(words[1])[:3, :3].T))
    if words := re.fullmatch(r"the positions of the poses are multiplied by (?:1/)?([\d.]+)", what):
        factor = 1 / float(words[1]) if "1/" in what else float(words[1])
        return motions(with_part(POSES, 3, factor * POSES[:, :3, 3]))
    if words := re.fullmatch(r"the sensor is rotated by (-?\d+) degrees in (yaw|pitch) against .*", what):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler(
            "zy"[words[2] == "pitch"], float(words[1]), degrees=True
        ).as_matrix()
        return motions(POSES @ turn)
    if what == "the order of the scans is reversed":
        return motions(POSES[::-1])
    quaternions = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    if what == "the quaternions of the poses are w x y z, and were read as x y z w":
        quaternions = quaternions[:, [1, 2, 3, 0]]
    elif what == "the quaternions of the poses are x y z w, and were read as w x y z":
        quaternions = quaternions[:, [3, 0, 1, 2]]
    return motions(with_part(POSES, slice(3), Rotation.from_quat(quaternions).as_matrix()))


def test_hypotheses_move_the_scans_as_described():
    found = list(hypotheses(POSES, PAIRS))
    by_kind = {guess.finding: guess for guess in found}
    np.testing.assert_allclose(by_kind["poses_inverted"].T_j_i, motions(np.linalg.inv(POSES)), atol=1e-12)
    np.testing.assert_array_equal(by_kind["points_in_world_frame"].T_j_i, np.tile(np.eye(4), (2, 1, 1)))
    others = [guess for guess in found[2:] if guess.finding != "angles_in_degrees"]
    for guess in others:
        np.testing.assert_allclose(guess.T_j_i, expected(guess.what), atol=1e-9, err_msg=guess.what)
        if guess.what.startswith("the points are read"):
            assert guess.up == tuple(read_as(guess.what[24:-1])[2, :3])
    words = [guess.what for guess in others]
    assert len(set(words)) == len(words) == 2 * 47 + 6 + 2 + 2 * (9 + 4) + 1
    of_axes = {guess.what: guess.finding for guess in others}
    assert of_axes["the points are read as (z, -x, -y)"] == "camera_frame"
    assert of_axes["the points are read as (-y, -z, x)"] == "camera_frame"
    assert of_axes["the points are read as (x, -y, z)"] == "mirrored"
    assert of_axes["the points are read as (-x, -y, z)"] == "axes_swapped"
    assert of_axes["the points are read as (y, x, z)"] == "axes_swapped"
    cheap = [guess.what for guess in hypotheses(POSES, PAIRS, all_axes=False)]
    axes = {what for what in cheap if "points are read" in what}
    assert len(axes) == 7 + 1 + 2
    assert {"the points are read as (x, -y, -z)", "the points are read as (z, -x, -y)"} <= axes


@pytest.mark.parametrize(
    ("factor", "what"),
    [(np.pi / 180, "the angles of the poses are taken for rad, not degrees"),
     (180 / np.pi, "the angles of the poses are taken for degrees, not rad")],
)  # fmt: skip
def test_angles_in_another_unit_are_converted_back(factor, what):
    """A drive that turns by 1 to 3 degrees per scan, from a heading of 40: as rad, these are six turns and more."""
    yaws = np.radians(40 + np.cumsum([0, 1, 2, 3, 3, 3]))[:, None]
    true, broken = (np.tile(np.eye(4), (6, 1, 1)) for _ in range(2))
    true[:, :3, :3] = Rotation.from_euler("z", yaws).as_matrix()
    true[:, 0, 3] = broken[:, 0, 3] = np.arange(6)
    broken[:, :3, :3] = Rotation.from_euler("z", factor * yaws).as_matrix()
    tried = [guess for guess in hypotheses(broken, PAIRS) if guess.finding == "angles_in_degrees"]
    assert what in {guess.what for guess in tried if np.allclose(guess.T_j_i, motions(true), atol=1e-9)}


def test_scores_against_a_plain_calculation():
    scans = [RNG.normal(0, 1, (60, 3)), RNG.normal(0, 1, (50, 3))]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_euler("z", 0.3).as_matrix(), [0.4, -0.2, 0.1]

    def one_way(a, b, T):
        moved = a @ T[:3, :3].T + T[:3, 3]
        own = np.sort(np.linalg.norm(b[:, None] - b, axis=2), axis=1)[:, 1:5].mean(axis=1)
        distances = np.linalg.norm(moved[:, None] - b, axis=2)
        nearest = distances.argmin(axis=1)
        return np.log(np.clip(distances.min(axis=1) / own[nearest], 0.1, 1.5)).mean()

    score = 0.5 * (one_way(*scans, motion) + one_way(*scans[::-1], np.linalg.inv(motion)))
    agreement = Agreement(scans, returns=60, queries=60)
    assert agreement.scores(np.array([[0, 1]]), motion[None, None])[0, 0] == pytest.approx(score, rel=1e-9)
    own = np.sort(np.linalg.norm(scans[0][:, None] - scans[0], axis=2), axis=1)[:, 1:5].mean(axis=1)
    assert agreement.spacing_m(0) == pytest.approx(np.median(own))
    few = Agreement([scans[0][:6], scans[0][:5]], 60, 60)
    assert few.spacing_m(0) > 0 == few.spacing_m(1)
