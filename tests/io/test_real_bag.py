"""A real ROS 1 bag of a handheld radar, with header stamps of zero, is read completely."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read

from ..conftest import recorded_file

pytest.importorskip("rosbags", reason="the extra ros is not installed")


def test_it_becomes_the_scans_that_it_holds():
    bag = recorded_file("ti_iwr6843/ti_mmwave_rospkg_demo.bag")
    scans = read(bag, recorded_file("ti_iwr6843/poses.tum"))
    with np.load(recorded_file("ti_iwr6843/ti_scene.npz")) as expected:
        assert_array_equal(np.concatenate(scans.points), expected["points"])
        assert_array_equal(np.concatenate(scans.intensities), expected["intensity"])
        assert_array_equal(np.concatenate(scans.doppler_mps), expected["doppler"])
        assert_array_equal([len(p) for p in scans.points], np.bincount(expected["frame"]))
        # Unlike those of the text file, the expected poses are not rounded or interpolated.
        assert_allclose(scans.poses, expected["poses"], rtol=0, atol=2e-6)
        # The expected times are smoothed record times.
        assert_allclose(np.diff(scans.times_s), np.diff(expected["times"]), rtol=0, atol=0.02)
    assert "header stamps of /ti_mmwave/radar_scan_pcl are zero" in scans.notes[0]
    assert scans.notes[1].startswith("197 scans left out")
    assert len(scans.notes) == 2
