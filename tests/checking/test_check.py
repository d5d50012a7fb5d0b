"""Input of a check, pose errors against noise, and drift."""

import dataclasses
import re

import numpy as np
import pytest
import radarsdf
from radarsdf.checking import trajectory as trajectory_checks
from radarsdf.checking.noise import check_noise_and_cost
from radarsdf.checking.recording import checked_input
from radarsdf.checking.trajectory import check_drift
from radarsdf.io import Scans
from radarsdf.simulate import drifted

from tests.conftest import recorded_file

from .breakages import WAYS, found_in, simulated, slow

SCANS = 36
CONFIG = radarsdf.FitConfig(num_threads=1)


def test_scans_are_accepted_as_input():
    drive = radarsdf.simulate.wall(frames=4)
    constant = [np.full(len(values), 7.0) for values in drive.intensities]
    times_s = np.array([0.0, 0.1, 0.1, 0.2])
    given = radarsdf.check(drive.points, drive.poses, constant, times_s=times_s)
    read = radarsdf.check(Scans(drive.points, drive.poses, constant, times_s=times_s))
    assert [str(finding) for finding in read] == [str(finding) for finding in given]
    assert {"intensity_constant", "times"} <= {finding.name for finding in read}


def test_arrays_need_poses():
    with pytest.raises(ValueError, match="poses are missing"):
        radarsdf.check([np.ones((3, 3))])


def added_m(points, poses):
    """Noise added by the poses according to the note, m. None without a note."""
    findings = check_noise_and_cost(checked_input(points, poses), CONFIG)
    notes = [finding.evidence for finding in findings if finding.name == "poses_disagree"]
    if not notes:
        return None
    significance = int(re.search(r"surfaces, (\d+) standard errors", notes[0])[1])
    assert 3 <= significance < 1000  # fewer are not noted
    return float(re.search(r"about ([0-9.]+) m", notes[0])[1])


@pytest.mark.parametrize(("kind", "frames"), [("hugin", 16), ("wall", 20)])
def test_exact_poses_add_nothing(kind, frames):
    scans = getattr(radarsdf.simulate, kind)(frames=frames, seed=1)
    assert added_m(scans.points, scans.poses) is None


def test_height_errors_between_scans_are_estimated_in_metres():
    scans = radarsdf.simulate.wall(frames=40, seed=1)
    poses = scans.poses.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.03, (40, 3))
    assert added_m(scans.points, poses) == pytest.approx(0.03, rel=0.5)


def test_a_drifted_return_trip_is_found():
    scans = radarsdf.simulate.wall(frames=20, seed=1)
    points, rng = list(scans.points), np.random.default_rng(0)
    points += [scan + rng.normal(0, 1e-3, scan.shape) for scan in reversed(scans.points)]
    poses = np.concatenate([scans.poses, scans.poses[::-1]])
    poses[:, :3, 3] += 0.4 * np.linspace(0, 1, 40)[:, None] * poses[0, :3, 1]
    assert added_m(points, poses) > 0.02


@pytest.fixture(scope="module")
def drive():
    whole = radarsdf.simulate.wall(seed=62)
    return Scans(whole.points[:SCANS], whole.poses[:SCANS])


def recording(drive, poses, rows=slice(None)):
    return checked_input(drive.points[rows], poses[rows])


def test_a_drift_is_reported_with_its_magnitude(drive):
    (found,) = check_drift(recording(drive, drifted(drive.poses, 0.05, 0.004, 1)), CONFIG)
    assert found.name == "poses_drift"
    assert found.severity == "warning"
    assert "denser at held-out returns" in found.evidence
    assert "radarsdf poses" in found.fix


def test_true_poses_have_no_drift(drive):
    assert list(check_drift(recording(drive, drive.poses), CONFIG)) == []
    assert list(check_drift(recording(drive, drive.poses, slice(0, 3)), CONFIG)) == []


def test_a_gain_without_effect_is_no_drift():
    with np.load(recorded_file("aimotive_motorway/radar.npz")) as drive:
        points = np.split(drive["F_LRR_C_points"], np.cumsum(drive["F_LRR_C_counts"])[:-1])
        poses = drive["F_LRR_C_poses"]
    assert list(check_drift(checked_input(points, poses), CONFIG)) == []


def test_large_recordings_are_checked_in_windows(drive, monkeypatch):
    asked = []
    refine = trajectory_checks.refine_poses

    def counted(points, poses, **settings):
        asked.append((len(poses), sum(map(len, points))))
        return refine(points, poses, **settings)

    monkeypatch.setattr(trajectory_checks, "refine_poses", counted)
    monkeypatch.setattr(trajectory_checks, "_SCANS", 12)
    monkeypatch.setattr(trajectory_checks, "_RETURNS", 8000)
    (found,) = check_drift(recording(drive, drifted(drive.poses, 0.05, 0.004, 1)), CONFIG)
    assert [scans for scans, _ in asked] == [12, 12, 12]
    assert max(returns for _, returns in asked) <= 8500
    assert "of 3 windows of the recording" in found.evidence


@pytest.mark.parametrize("kind", ["hugin"])
def test_a_drift_below_the_noise_of_a_coarse_sensor_is_not_reported(kind):
    creep = slow(kind, 0.02, seed=6, cell=0.5)
    assert list(check_drift(checked_input(creep.points, creep.poses), CONFIG)) == []


@pytest.fixture(scope="module")
def good():
    return simulated("wall", 14)


def differs(a, b):
    pairs = ((getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a))
    return any(
        len(x) != len(y) or any(not np.array_equal(u, v) for u, v in zip(x, y, strict=True)) for x, y in pairs
    )


def test_good_data_have_nothing_worse_than_notes(good):
    assert [name for name, severity in found_in(good, cheap=False) if severity != "note"] == []
    assert [name for name, severity in found_in(good, cheap=True) if severity != "note"] == []


# A steady motion is the same at any time, and a slow one hardly differs from none: tests/checking has clocks that are off
# where the motion changes, and drifts.
NOT_HERE = {
    "poses of two scans before",
    "degrees taken for rad",
    "drift of 1.5 m and 6 degrees",
    "there and back, drift of 0.4 m",
}


# The checks of `fit` also report the others, in a tenth of the time.
WHOLE_CHECK = {"poses of a vehicle, sensor turned by 15 degrees of pitch", "Doppler with the other sign"}


SEVERITIES = {
    "intensity_constant": "error",
    "intensity_is_doppler": "error",
    "intensity_steps": "note",
    "intensity_offset": "note",
}


@pytest.mark.parametrize("way", sorted(set(WAYS) - NOT_HERE))
def test_a_breakage_is_named(good, way, request):
    finding, broken = WAYS[way]
    if finding.startswith(("intensity", "duplicate", "below")):
        request.getfixturevalue("right_frames")
    data = broken(good)
    assert differs(good, data)
    found = dict(found_in(data, cheap=way not in WHOLE_CHECK))
    assert finding in found
    if finding.startswith("intensity"):
        assert found[finding] == SEVERITIES.get(finding, "warning")
