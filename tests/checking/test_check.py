# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The check takes arrays, or scans as they are read."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.io import Scans


def test_scans_are_taken_as_they_are():
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
