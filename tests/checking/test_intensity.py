"""Broken intensities, and returns below the ground."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.noise import check_elevation, check_ground, check_intensities
from radarsdf.checking.recording import checked_input

pytestmark = pytest.mark.usefixtures("right_frames")


@pytest.fixture(scope="module")
def good():
    scans = radarsdf.simulate.wall(frames=10)
    return scans.points, scans.poses, scans.intensities


def replaced(values, every, value):
    """Replaces intensities at regular intervals by other values."""
    whole = np.concatenate(values)
    whole[::every] = value
    return np.split(whole, np.cumsum([len(v) for v in values])[:-1])


def test_good_intensities_are_at_most_noted(good):
    names = {finding.name: finding.severity for finding in radarsdf.check(*good)}
    assert set(names.values()) == {"note"}
    assert not {name for name in names if name.startswith("intensity")} - {"intensity_steps"}
    assert {"noise", "cost"} <= set(names)


def test_intensity_outliers_are_counted_and_named(good):
    points, poses, intensities = good
    whole = np.concatenate(intensities)
    broken = replaced(intensities, 50, -9999.0)
    broken[7][1:8] = 65535
    broken[3][2] = 1e9  # a single one, in a scan that a sample may miss
    found = {finding.name: finding for finding in check_cheaply(points, poses, broken)}
    counts = {
        name: int(found[name].evidence.split()[0]) for name in ("intensity_sentinel", "intensity_outliers")
    }
    values = np.concatenate(broken)
    assert counts == {
        "intensity_sentinel": int(np.isin(values, [-9999, 65535]).sum()),
        "intensity_outliers": 1,
    }
    assert f"of {len(whole)} intensities" in found["intensity_sentinel"].evidence
    assert "are -9999, 65535, far from the others" in found["intensity_sentinel"].evidence
    assert "are 1e+09" in found["intensity_outliers"].evidence


def said(*scans):
    """Findings about intensities, (N,) each."""
    points = [np.zeros((len(values), 3)) for values in scans]
    found = check_intensities(checked_input(points, np.tile(np.eye(4), (len(scans), 1, 1)), list(scans)))
    return [f"{finding.severity}: {finding.name}: {finding.evidence}" for finding in found]


def test_scales_are_described_by_steps_offset_and_limits():
    steps = "note: intensity_steps: Intensities are "
    even = np.repeat(np.arange(10) / 2, 100)
    assert said(even) == [f"{steps}0 to 4.5, in steps of 0.5."]
    assert said(even[::11][:99]) == []  # too few returns for a scale
    assert said(np.linspace(0, 1, 1000)) == []
    assert said(np.linspace(0, 1, 999)) == [f"{steps}0 to 1, in steps of 0.001."]
    offset = np.tile(np.arange(100, 140), 10)
    assert said(offset)[1:] == [
        "note: intensity_offset: Intensities are whole numbers with the median 119.5, like dBsm with 128 added."
    ]
    assert said(offset - 34)[1:] == []  # the median is 42.5 from 128
    assert said(np.tile(np.arange(60, 140), 10))[1:] == []  # a twentieth is below 64
    for count, severity in ((20, []), (21, ["note"]), (50, ["note"]), (51, ["warning"])):
        # Some of 1000 intensities at the end, after four at each previous value.
        counts = [1000 - 48 - count, *[4] * 12, count]
        ends = [words for words in said(np.repeat(np.arange(14), counts)) if "clipped" in words]
        what = f"{count / 10:.1f}% of the intensities have the highest value, 13."
        assert ends == [f"{kind}: intensity_clipped: {what}" for kind in severity]


def test_constant_intensities_differ_from_intensities_constant_per_scan():
    assert said(np.ones(3), np.ones(2)) == ["error: intensity_constant: All intensities are 1."]
    held = [np.full(3, float(i)) for i in range(3)]
    constant = "warning: intensity_constant_in_scans: In {} of the scans all returns have the same intensity."
    assert said(*held, np.array([1.0, 2.0]), np.ones(1)) == [constant.format("75%")]
    assert said(*held[:2], np.array([1.0, 2.0]), np.array([3.0, 2.0])) == []
    assert said(np.full(3, np.nan)) == [
        "error: intensity_not_finite: 100.00% of the intensities are not finite."
    ]


def test_the_ground_is_at_the_mode_of_returns_below_the_sensor():
    """Ground 1.4 m below the sensor, 10 m away; returns more than 1 m and a tenth of the distance below are reflections."""
    ground, above = np.tile([9.9, 0, -1.4], (800, 1)), np.tile([10.0, 0, 0.5], (160, 1))
    reflected, deep, far = (np.tile(p, (20, 1)) for p in ([9.4, 0, -3.25], [9.4, 0, -3.5], [24.9, 0, -9.0]))
    turned = np.diag([1.0, -1, -1, 1])  # the sensor hangs upside down
    scans = [
        np.concatenate([ground, above, reflected, deep, far]),
        np.concatenate([ground, above]) * [1, -1, -1],
    ]
    (found,) = check_ground(checked_input(scans, [np.eye(4), turned]))
    assert found.severity == "note"
    assert found.evidence == (
        f"{20 / 1960:.1%} of returns within 25 m are clearly below the ground, 1.4 m below the sensor."
    )
    assert list(check_ground(checked_input([np.concatenate([ground, above, reflected])], [np.eye(4)]))) == []
    assert list(check_ground(checked_input([np.concatenate([ground[:50], deep, deep])], [np.eye(4)]))) == []


@pytest.mark.parametrize(("returns", "thickness_m", "found"), [(100, 1e-6, 1), (99, 1e-6, 0), (100, 0.01, 0)])
def test_returns_in_a_plane_have_no_elevation(returns, thickness_m, found):
    plane = np.random.default_rng(0).uniform(-10, 10, (returns, 3)) * [1, 1, thickness_m / 10]
    assert len(list(check_elevation(checked_input([plane], [np.eye(4)])))) == found
