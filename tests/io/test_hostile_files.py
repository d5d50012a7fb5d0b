"""Damaged and malicious files are read, or rejected by an error that names them."""

import itertools
import json
import pickle
import resource
import warnings
import zipfile

import numpy as np
import pytest
import radarsdf
from radarsdf.io.npz import read_scans

from .. import samples
from . import hostile_files as files

FILES = 70


@pytest.mark.parametrize("name", files.READERS)
def test_damaged_files_are_read_or_refused(name, tmp_path, monkeypatch):
    monkeypatch.setattr("radarsdf.io.meshes._SAMPLES", 1000)  # of each surface that is read
    reader = files.READERS[name]
    path = files.place(reader, tmp_path)
    outcomes = files.Outcomes()
    # Samples the truncations at every boundary with which the long run begins.
    cuts = sum(1 + len(files.boundaries(data)) for data in reader.valid())
    stream = files.damaged(reader, seed=0)
    some = list(itertools.islice(stream, 0, cuts, 7)) + list(itertools.islice(stream, FILES))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's, of numbers too large for a type
        for data in some:
            files.try_file(reader, path, data, outcomes)
    assert outcomes.failures == []
    assert outcomes.counts["read"] > 0
    # In a folder, complete scans are read and the damaged one is skipped.
    assert outcomes.counts["ValueError"] > FILES / 10 or name == "folder: scan"


@pytest.fixture
def bounded_memory():
    """Peak memory may grow by 300 MB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    growth_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth_kb < 300_000


class Plant:
    """An object whose unpickling creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickles_are_not_executed(tmp_path):
    planted = tmp_path / "executed"
    objects = np.array([Plant(str(planted))] * 2, object)
    pickle.loads(pickle.dumps(objects[0])).close()
    planted.unlink()  # so unpickling would have created it

    path = tmp_path / "scans.npz"
    for name in ("points", "frame", "lidar_points", "static"):
        arrays = {"points": np.ones((2, 3)), "frame": np.zeros(2), "poses": np.eye(4)[None]}
        np.savez(path, **(arrays | {name: objects}))
        with pytest.raises(ValueError, match=r"scans\.npz"):
            read_scans(path)
    for content in (pickle.dumps(objects), pickle.dumps(Plant(str(planted)))):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"scans\.npz"):
            read_scans(path)
        (tmp_path / "map.safetensors").write_bytes(content)
        with pytest.raises(ValueError, match=r"map\.safetensors"):
            radarsdf.load(tmp_path / "map.safetensors")
    assert not planted.exists()


@pytest.mark.usefixtures("bounded_memory")
def test_a_zip_bomb_is_not_unpacked(tmp_path):
    path = tmp_path / "scans.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("points.npy", "w") as member:
        member.write(samples._claim((10**8, 3)))
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ValueError, match=r"scans\.npz.*would unpack"):
        read_scans(path)


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("shape", [(10**9, 3), (2**32, 2**32), (-1, 3)])
def test_shapes_that_no_file_holds(tmp_path, shape):
    path = tmp_path / "scans.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("points.npy", samples._claim(shape))
    with pytest.raises(ValueError, match=r"scans\.npz is not a complete"):
        read_scans(path)


def with_config(group, **changes):
    data = samples.maps()[0]
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    description = json.loads(header["__metadata__"]["description"])
    description["config"][group].update(changes)
    # Older files have no checksums, which would find the change.
    kept = {k: v for k, v in header["__metadata__"].items() if not k.startswith("crc32")}
    header["__metadata__"] = kept | {"description": json.dumps(description)}
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("networks", "intensity_hidden", [30_000] * 3),
        ("networks", "intensity_hidden", [4096] * 3),
        ("networks", "intensity_hidden", [2**62, 2**62]),
        ("networks", "intensity_hidden", [1] * 1_000_000),
        ("networks", "geometry_feature_dim", 10**9),
        ("encoding", "fourier_count", 24),
    ],
)
def test_a_map_that_describes_more_than_it_holds(tmp_path, group, name, value):
    path = tmp_path / "map.safetensors"
    path.write_bytes(with_config(group, **{name: value}))
    with pytest.raises(ValueError, match=r"map\.safetensors is not a complete"):
        radarsdf.load(path)
