# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Messages of radars' own types."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from radarsdf.io import UNPOSED, read

from ..conftest import recorded_file

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from rosbags.typesys import get_types_from_msg

from .bag_writing import BagWriter
from .test_bags import START_S, columns, odometry

OTHER = {"acme_msgs/msg/RadarFrame": "std_msgs/Header header\nfloat32[] range\n"}


def register(bag, definitions):
    for name, text in definitions.items():
        bag.store.register(get_types_from_msg(text, name))


def test_an_ars548_as_it_was_recorded():
    """Packets of the radar, and the same scan as its driver decoded it."""
    yaml = pytest.importorskip("yaml", reason="pyyaml is not installed")
    scans = read(
        recorded_file("ars548"), UNPOSED
    )  # a folder whose file has another name than its metadata say
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    decoded = yaml.load(recorded_file("ars548/ars548_detection.yaml").read_text(), loader)["detections"]
    names = ("range", "azimuth_angle", "elevation_angle", "range_rate", "rcs", "range_std", "azimuth_angle_std", "elevation_angle_std")  # fmt: skip
    r, azimuth, elevation, rate, rcs, *sigma = np.array([[d[name] for name in names] for d in decoded]).T
    (scan,) = scans
    assert len(scan) == len(decoded) == 308
    flat = r * np.cos(elevation)
    expected = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), r * np.sin(elevation)], axis=1)
    assert_allclose(scan.points, expected, rtol=1e-5, atol=1e-3)
    assert_allclose(scan.doppler_mps, rate, rtol=1e-5)
    assert_allclose(scan.intensities, rcs)
    assert_allclose(scan.sigma, np.stack(sigma, axis=1), rtol=1e-5)


@pytest.mark.parametrize("cloud", ["lidar", "radar by name"])
def test_a_lidar_does_not_stand_for_a_radar_that_cannot_be_read(tmp_path, cloud):
    topic = "/radar/points" if cloud == "radar by name" else "/points"
    path = tmp_path / "a"
    with BagWriter(path, "mcap") as bag:
        odometry(bag)
        register(bag, OTHER)
        message = bag.make(
            "acme_msgs/msg/RadarFrame", bag.header(START_S, "base_link"), np.zeros(3, np.float32)
        )
        bag.write("/front", message, START_S)
        bag.write(topic, bag.cloud2(START_S, columns(1)), START_S)
    if cloud == "lidar":
        with pytest.raises(ValueError, match=r"/front \(acme_msgs/msg/RadarFrame\).* give topic /points"):
            read(path)
        assert len(read(path, topic="/points")) == 1
    else:
        assert any("not read: /front (acme_msgs/msg/RadarFrame)" in note for note in read(path).notes)
