# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One cloud of all returns, written scan by scan, and read back to the same numbers."""

from importlib.util import find_spec

import numpy as np
import pytest
from radarsdf.io.cloud_writing import CLOUD_OUT_SUFFIXES, write_cloud
from radarsdf.io.clouds import read_columns, read_points
from radarsdf.scans import Notes, Scan, Scans

UTM_M = np.array([691_000.0, 5_335_000.0, 520.0])
COUNTS = (3, 1, 250)


def one_scan(number, origin, optional=True):
    rng = np.random.default_rng(number)
    count = COUNTS[number]
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    T[:3, 3] = np.add(origin, [number, 0, 0])
    points = rng.normal(0, 30, (count, 3))
    if not optional:
        return Scan(points, T)
    intensities, doppler = (rng.normal(0, 30, count).astype(np.float32) for _ in range(2))
    return Scan(points, T, intensities, doppler, 1.7e9 + 0.1 * number)


def lazily(origin, optional=True):
    """Scans of a source, and how often they were read."""
    reads = []

    def source():
        reads.append(1)
        return (one_scan(number, origin, optional) for number in range(len(COUNTS)))

    return Scans.of_source(source, Notes()), reads


def expected(origin):
    scans = [one_scan(number, origin) for number in range(len(COUNTS))]
    columns = dict(
        zip(
            "xyz",
            np.concatenate(
                [s.points @ s.T_world_sensor[:3, :3].T + s.T_world_sensor[:3, 3] for s in scans]
            ).T,
            strict=True,
        )
    )
    columns["intensity"] = np.concatenate([s.intensities for s in scans])
    columns["doppler"] = np.concatenate([s.doppler_mps for s in scans])
    columns["scan"] = np.repeat(np.arange(len(COUNTS)), COUNTS)
    columns["time"] = np.concatenate([np.full(len(s), s.time_s) for s in scans])
    return columns


@pytest.mark.parametrize("suffix", CLOUD_OUT_SUFFIXES)
@pytest.mark.parametrize("origin", [np.zeros(3), UTM_M], ids=["near", "UTM"])
def test_the_same_numbers_come_back(tmp_path, suffix, origin):
    if suffix in (".las", ".laz") and find_spec("laspy") is None:
        pytest.skip("laspy is not installed")
    scans, reads = lazily(origin)
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".pcd" and origin[0] > 0:
        with pytest.raises(ValueError, match="float32"):
            write_cloud(path, scans)
        return
    assert (write_cloud(path, scans), reads) == (sum(COUNTS), [1])
    columns, right = read_columns(path), expected(origin)
    for name in ("intensity", "doppler", "scan", "time"):
        np.testing.assert_array_equal(columns[name].astype(right[name].dtype), right[name])
    tolerance_m = {".las": 6e-5, ".laz": 6e-5, ".pcd": 1e-5}.get(suffix, 0)
    world = np.stack([right[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(read_points(path), world, rtol=0, atol=tolerance_m)


def test_columns_that_scans_lack(tmp_path):
    scans, _ = lazily(np.zeros(3), optional=False)
    write_cloud(tmp_path / "cloud.ply", scans)
    assert list(read_columns(tmp_path / "cloud.ply")) == ["x", "y", "z", "scan"]
    mixed = Scans.of_source(lambda: iter([one_scan(0, 0.0), one_scan(1, 0.0, optional=False)]), Notes())
    write_cloud(tmp_path / "mixed.csv", mixed)
    assert "intensity" not in read_columns(tmp_path / "mixed.csv")


def test_a_source_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")

    def source():
        yield one_scan(0, 0.0)
        raise FileNotFoundError(2, "gone", "scan.pcd")

    with pytest.raises(FileNotFoundError) as error:
        write_cloud(path, Scans.of_source(source, Notes()))
    assert error.value.filename == "scan.pcd"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"old"
