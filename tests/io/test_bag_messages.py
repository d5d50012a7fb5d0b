"""Messages of vendor-specific radar types."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from radarsdf.io import UNPOSED, read

from ..conftest import recorded_file

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from rosbags.typesys import get_types_from_msg

from .bag_writing import BagWriter
from .test_bags import START_S, columns, odometry

FLAGS = [
    f"invalid_{value}{std}"
    for value in ("distance", "azimuth", "elevation", "range_rate")
    for std in ("", "_std")
]
NEBULA = {
    "continental_msgs/msg/ContinentalArs548Detection": "float32 azimuth_angle\nfloat32 azimuth_angle_std\n"
    + "".join(f"bool {flag}\n" for flag in FLAGS)
    + "float32 elevation_angle\nfloat32 elevation_angle_std\nfloat32 range\nfloat32 range_std\nfloat32 range_rate\n"
    "float32 range_rate_std\nint8 rcs\nuint16 measurement_id\nuint8 raw_positive_predictive_value\n"
    "uint8 classification\nuint8 raw_multi_target_probability\nuint16 object_id\nuint8 raw_ambiguity_flag\n",
    "continental_msgs/msg/ContinentalArs548DetectionList": "std_msgs/Header header\nuint8 stamp_sync_status\n"
    "geometry_msgs/Point origin_pos\nfloat32 origin_pitch\nfloat32 origin_pitch_std\nfloat32 origin_yaw\n"
    "float32 origin_yaw_std\nfloat32 ambiguity_free_velocity_min\nfloat32 ambiguity_free_velocity_max\n"
    "float32 alignment_azimuth_correction\nfloat32 alignment_elevation_correction\nuint8 alignment_status\n"
    "continental_msgs/ContinentalArs548Detection[] detections\n",
}  # fmt: skip
ARS548 = {
    "ars548_messages/msg/Detection": "float32 f_azimuthangle\nfloat32 f_azimuthanglestd\nuint8 u_invalidflags\n"
    "float32 f_elevationangle\nfloat32 f_elevationanglestd\nfloat32 f_range\nfloat32 f_rangestd\nfloat32 f_rangerate\n"
    "float32 f_rangeratestd\nint8 s_rcs\nuint16 u_measurementid\nuint8 u_positivepredictivevalue\nuint8 u_classification\n"
    "uint8 u_multitargetprobabilitym\nuint16 u_objectid\nuint8 u_ambiguityflag\nuint16 u_sortindex\n",
    "ars548_messages/msg/DetectionList": "std_msgs/Header header\nuint64 crc\nuint32 length\nuint32 sqc\nuint32 dataid\n"
    "uint32 timestamp_nanoseconds\nuint32 timestamp_seconds\nuint8 timestamp_syncstatus\nuint32 eventdataqualifier\n"
    "uint8 extendedqualifier\nuint16 origin_invalidflags\n"
    + "".join(f"float32 origin_{n}\n" for n in ("xpos", "xstd", "ypos", "ystd", "zpos", "zstd", "roll", "rollstd", "pitch", "pitchstd", "yaw", "yawstd"))
    + "uint8 list_invalidflags\nars548_messages/Detection[800] list_detections\nfloat32 list_radveldomain_min\n"
    "float32 list_radveldomain_max\nuint32 list_numofdetections\nfloat32 aln_azimuthcorrection\n"
    "float32 aln_elevationcorrection\nuint8 aln_status\n",
}  # fmt: skip
OTHER = {"acme_msgs/msg/RadarFrame": "std_msgs/Header header\nfloat32[] range\n"}


def register(bag, definitions):
    for name, text in definitions.items():
        bag.store.register(get_types_from_msg(text, name))


def nebula_detection(bag, azimuth, elevation, range_m, rate, rcs, invalid=()):
    flags = [flag in invalid for flag in FLAGS]
    values = (azimuth, 0.01, *flags, elevation, 0.02, range_m, 0.2, rate, 0.25, rcs, 7, 100, 0, 20, 3, 50)
    return bag.make("continental_msgs/msg/ContinentalArs548Detection", *values)


def nebula_list(bag, detections):
    origin = bag.make("geometry_msgs/msg/Point", 3.9, 0.0, 0.6)
    header = bag.header(START_S, "base_link")
    return bag.make(
        "continental_msgs/msg/ContinentalArs548DetectionList", header, 1, origin,
        0.0, 0.005, 0.0, 0.03, -22.9, 22.9, 0.0, 0.0, 0, detections,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("driver", ["nebula", "ars548_messages"])
def test_ars548(tmp_path, kind, driver):
    """Azimuth is positive to the left, elevation upwards; returns flagged as invalid are excluded."""
    path = tmp_path / ("a.bag" if kind == "ros1" else "a")
    with BagWriter(path, kind) as bag:
        odometry(bag)
        if driver == "nebula":
            register(bag, NEBULA)
            rows = [
                nebula_detection(bag, np.pi / 2, 0.0, 10.0, -3.0, -10),
                nebula_detection(bag, 0.0, np.pi / 6, 20.0, 4.0, 25, ("invalid_range_rate", "invalid_azimuth_std")),
                nebula_detection(bag, 0.3, 0.0, 30.0, 4.0, 25, ("invalid_elevation",)),
            ]  # fmt: skip
            message = nebula_list(bag, rows)
        else:
            register(bag, ARS548)
            values = [
                (np.pi / 2, 0.01, 0, 0.0, 0.02, 10.0, 0.2, -3.0, 0.25, -10),
                (0.0, 0.01, 0x40 | 0x08, np.pi / 6, 0.02, 20.0, 0.2, 4.0, 0.25, 25),
                (0.3, 0.01, 0x10, 0.0, 0.02, 30.0, 0.2, 4.0, 0.25, 25),
            ]
            rows = [
                bag.make("ars548_messages/msg/Detection", *row, 7, 100, 0, 20, 3, 50, 1)
                for row in [*values, *values[:1] * 797]
            ]
            message = bag.make(
                "ars548_messages/msg/DetectionList", bag.header(START_S, "base_link"), 1, 2, 3, 4, 5, 6, 1, 0, 0, 0,
                *np.zeros(12), 0, rows, -22.9, 22.9, 3, 0.0, 0.0, 1,
            )  # fmt: skip
        bag.write("/detections", message, START_S)
    scans = read(path)
    (scan,) = scans
    assert_allclose(scan.points, [[0, 10, 0], [20 * np.cos(np.pi / 6), 0, 10]], atol=1e-5)
    assert_allclose(scan.doppler_mps, [-3, np.nan])
    assert_allclose(scan.intensities, [-10, 25])
    assert_allclose(scan.sigma, [[0.2, 0.01, 0.02]] * 2, rtol=1e-6)
    assert any(note.startswith("1 returns left out") for note in scans.notes)


def test_an_ars548_as_it_was_recorded():
    """Packets of the radar, and the same scan as its driver decoded it."""
    yaml = pytest.importorskip("yaml", reason="pyyaml is not installed")
    scans = read(recorded_file("ars548"), UNPOSED)  # a folder with a file name that differs from its metadata
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
def test_a_lidar_does_not_replace_an_unreadable_radar(tmp_path, cloud):
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
