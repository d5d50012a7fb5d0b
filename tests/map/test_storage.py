"""Map files are written atomically and loaded without a changed bit."""

import json
import math
import os
import pickle

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.io.tensors import open_tensors, tensor_bytes
from radarsdf.map.radar_map import load_leaf_keys
from safetensors.torch import save_file

from ..settings import grouped

QUICK = FitConfig(training={"sdf_iterations": 60, "intensity_iterations": 8, "batch_size": 1024})
SENSOR = np.array([0.5, 0.0, 1.5])


def fitted(scene, *, with_intensity=True, **changes):
    intensities = scene.intensities if with_intensity else None
    config = QUICK.override(**grouped(**changes))
    return radarsdf.fit(scene.points, scene.poses, intensities, config=config, progress=False)


@pytest.fixture(scope="module")
def saved(scene, tmp_path_factory):
    """A map with all parts, its file, and the file's parts."""
    radar_map = fitted(scene, reflectance="both", returns={"free_space": True})
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    radar_map.save(path)
    with open_tensors(path) as file:
        return radar_map, path, {name: file.array(name).clone() for name in file.names}, file.metadata


def write(path, tensors, metadata):
    path.write_bytes(tensor_bytes(tensors, metadata))
    return path


@pytest.mark.parametrize("encoding", ["tri-quadtree", "octree"])
@pytest.mark.parametrize("with_intensity", [True, False])
def test_a_loaded_map_is_bit_identical(scene, tmp_path, encoding, with_intensity):
    networks = {"normals": True, "geometry_feature_dim": 4, "intensity_hidden": (16,)}
    before = fitted(scene, with_intensity=with_intensity, kind=encoding, max_range_m=70.0, **networks)
    path = tmp_path / "map.safetensors"
    before.save(path)
    after = radarsdf.load(path)

    x = np.random.default_rng(0).uniform([8, -5, -1], [20.5, 5, 2], (12_000, 3))
    np.testing.assert_array_equal(after.sdf(x), before.sdf(x))
    np.testing.assert_array_equal(after.gradient(x), before.gradient(x))
    np.testing.assert_array_equal(after.observed(x), before.observed(x))
    meshes = [m.mesh(0.2, viewpoint=SENSOR if with_intensity else None) for m in (before, after)]
    assert len(meshes[0].faces) > 0
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    if with_intensity:
        np.testing.assert_array_equal(after.intensity(x, SENSOR), before.intensity(x, SENSOR))
        np.testing.assert_array_equal(*(m.vertex_attributes["intensity"] for m in meshes))

    assert after.config == before.config
    assert isinstance(after.config.networks.intensity_hidden, tuple)
    np.testing.assert_array_equal(after.origin, before.origin)
    assert after.origin.dtype == np.float64
    assert after.intensity_scale == before.intensity_scale
    assert after.has_intensity == with_intensity
    assert after.report == before.report
    assert (after.nbytes, repr(after)) == (before.nbytes, repr(before))


def test_the_file_is_plain_safetensors_with_units(saved):
    _, path, tensors, metadata = saved
    assert metadata["format"] == "radarsdf.map"
    assert metadata["format_version"] == "14"
    assert "positive in free space" in metadata["units"]
    assert {"origin", "leaf_keys", "field.cells.features"} <= set(tensors)
    with path.open("rb") as file:
        start = file.read(2)
    assert start != pickle.PROTO + b"\x04"
    assert start != b"PK"  # what torch.save writes: a zip of pickles


def test_files_of_other_programs_and_versions(saved, tmp_path):
    _, _, tensors, metadata = saved
    path = tmp_path / "other.safetensors"
    for foreign in (None, {"format": "pt"}, {"format": "radarsdf.mesh", "format_version": "1"}):
        save_file({"weight": torch.zeros(3)}, path, foreign)
        with pytest.raises(ValueError, match="is not a complete radarsdf map"):
            radarsdf.load(path)
    for version in ("12", "", "1.5", "one"):
        write(path, tensors, metadata | {"format_version": version})
        with pytest.raises(ValueError, match="format version"):
            radarsdf.load(path)
    for content in (b"\xff" * 64, b"ply\nformat ascii 1.0\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is not a complete radarsdf map"):
            radarsdf.load(path)
    with pytest.raises(FileNotFoundError, match="nothing"):
        radarsdf.load(tmp_path / "nothing.safetensors")


def last(value):
    """A tensor with a changed last element."""

    def changed(tensor):
        tensor = tensor.clone()
        tensor.view(-1)[-1] = value
        return tensor

    return changed


def longer(tensor):
    return torch.cat([tensor, tensor[-1:]])


def flat(tensor):
    return tensor.reshape(1, -1)


TENSORS = [
    *((name, last(math.nan)) for name in ("field.cells.features", "field.sdf_network.layers.0.weight")),
    *((name, last(math.inf)) for name in ("origin", "information", "reflectance.means")),
    *((name, last(math.nan)) for name in ("view_statistics.intensities",)),
    ("information", last(-1.0)),
    *(
        (name, change)
        for name in ("information", "hits", "field.cells.features", "origin", "leaf_keys")
        for change in (longer, flat, torch.Tensor.half)
    ),
    ("leaf_keys", torch.Tensor.neg),
    ("reflectance.plane_keys", lambda t: t.flip(0)),
    ("reflectance.table", lambda t: t[1:]),
    ("free_space.keys", lambda t: t * 0),
    ("view_statistics.counts", torch.zeros_like),
    ("view_statistics.points", lambda t: t[:-1]),
    ("view_statistics.directions", lambda t: t.to(torch.int16)),
]


@pytest.mark.parametrize(("name", "change"), TENSORS)
def test_inconsistent_tensors_are_rejected(saved, tmp_path, name, change):
    _, _, tensors, metadata = saved
    path = write(tmp_path / "bad.safetensors", tensors | {name: change(tensors[name])}, metadata)
    with pytest.raises(ValueError, match="is not a complete radarsdf map"):
        radarsdf.load(path)


def test_keys_that_are_read_alone_are_checked(saved, tmp_path):
    _, path, tensors, metadata = saved
    keys = tensors["leaf_keys"]
    np.testing.assert_array_equal(load_leaf_keys(path), keys.numpy())
    for wrong in (
        keys.flip(0),
        longer(keys),
        flat(keys),
        keys.half(),
        torch.cat([-torch.ones_like(keys[:1]), keys]),
    ):
        damaged = write(tmp_path / "bad.safetensors", {"leaf_keys": wrong}, metadata)
        with pytest.raises(ValueError, match="is not a complete radarsdf map"):
            load_leaf_keys(damaged)


@pytest.mark.parametrize(
    "name", ["information", "visibility", "field.sdf_network.layers.2.bias", "free_space.planes"]
)
def test_missing_and_unknown_tensors_are_rejected(saved, tmp_path, name):
    _, _, tensors, metadata = saved
    for changed in ({n: t for n, t in tensors.items() if n != name}, tensors | {"field.x": torch.zeros(2)}):
        with pytest.raises(ValueError, match="is not a complete radarsdf map"):
            radarsdf.load(write(tmp_path / "bad.safetensors", changed, metadata))


DAMAGE = {
    "unknown setting": lambda d: d["config"].update(colour="red"),
    "a group a list": lambda d: d["config"].update(training=[1, 2]),
    "setting out of range": lambda d: d["config"].update(leaf_size_m=-0.2),
    "number beyond floats": lambda d: d["config"]["training"].update(sigma_cells=10**400),
    "other encoding": lambda d: d["config"]["encoding"].update(kind="octree", fourier_count=3),
    "other width": lambda d: d["config"]["networks"].update(sdf_hidden=[33, 32]),
    "config a list": lambda d: d.update(config=[1, 2]),
    "no report": lambda d: d.pop("report"),
    "report a number": lambda d: d.update(report=3),
    "clutter ratio": lambda d: d.update(clutter_ratio=1.01),
    "returns per cell": lambda d: d.update(returns_per_cell=math.nan),
    "scale of one number": lambda d: d.update(intensity_scale=[1.0]),
    "scale upside down": lambda d: d.update(intensity_scale=[2.0, 1.0]),
    "intensity without weights": lambda d: d.update(intensity_scale=None),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_inconsistent_metadata_are_rejected(saved, tmp_path, damage):
    _, _, tensors, metadata = saved
    description = json.loads(metadata["description"])
    DAMAGE[damage](description)
    damaged = metadata | {"description": json.dumps(description)}
    path = write(tmp_path / "bad.safetensors", tensors, damaged)
    with pytest.raises(ValueError, match="is not a complete radarsdf map"):
        radarsdf.load(path)


def test_a_failing_save_leaves_the_old_file_and_nothing_else(saved, tmp_path, monkeypatch):
    radar_map = saved[0]
    path = tmp_path / "map.safetensors"
    path.write_bytes(b"the old map")

    def fail(*_):
        msg = "no space left on device"
        raise OSError(msg)

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        radar_map.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]
    assert path.read_bytes() == b"the old map"


def test_view_statistics_are_kept_bit_for_bit(saved):
    loaded, expected = radarsdf.load(saved[1]).view_statistics(), saved[0].view_statistics()
    assert len(expected.counts) > 100
    for name in ("points", "directions", "ranges_m", "intensities", "counts"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(expected, name))
    assert loaded.sigma == expected.sigma > 0


def test_maps_that_load_would_reject_are_not_saved(scene, tmp_path):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False)
    path = tmp_path / "map.safetensors"
    radar_map.save(path)
    before = path.read_bytes()
    radar_map.field.distances_m[3] = np.nan
    with pytest.raises(ValueError, match="distances_m"):
        radar_map.save(path)
    assert path.read_bytes() == before


def test_flipped_bits_are_detected(saved, tmp_path):
    whole, rng, path = saved[1].read_bytes(), np.random.default_rng(0), tmp_path / "flipped.safetensors"
    for last in [4000, len(whole)] * 20:
        content = bytearray(whole)
        content[rng.integers(last)] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"flipped\.safetensors"):
            radarsdf.load(path)
