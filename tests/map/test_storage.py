# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map's file: whole or not at all, and the same bits again."""

from __future__ import annotations

import json
import math
import os
import pickle
import stat

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.io import files
from radarsdf.io.tensors import open_tensors, tensor_bytes
from safetensors.torch import load_file, save_file

from ..settings import grouped

QUICK = FitConfig(training={"sdf_iterations": 60, "intensity_iterations": 8, "batch_size": 1024})
SENSOR = np.array([0.5, 0.0, 1.5])


def fitted(scene, *, with_intensity=True, **changes):
    intensities = scene.intensities if with_intensity else None
    config = QUICK.override(**grouped(**changes))
    return radarsdf.fit(scene.points, scene.poses, intensities, config=config, progress=False)


@pytest.fixture(scope="module")
def saved(scene, tmp_path_factory):
    """A map, its file, and the file's parts."""
    return saved_parts(fitted(scene), tmp_path_factory.mktemp("map"))


def saved_parts(radar_map, folder):
    """A map, its file in this folder, and the file's parts."""
    path = folder / "map.safetensors"
    radar_map.save(path)
    with open_tensors(path) as file:
        return radar_map, path, {name: file.array(name).clone() for name in file.names}, file.metadata


def write(path, tensors, metadata):
    path.write_bytes(tensor_bytes(tensors, metadata))
    return path


def with_description(metadata, change):
    description = json.loads(metadata["description"])
    change(description)
    return metadata | {"description": json.dumps(description)}


@pytest.mark.parametrize("encoding", ["tri-quadtree", "octree"])
@pytest.mark.parametrize("with_intensity", [True, False])
def test_a_map_loads_to_the_same_bits(scene, tmp_path, encoding, with_intensity):
    before = fitted(
        scene,
        with_intensity=with_intensity,
        kind=encoding,
        normals=True,
        geometry_feature_dim=4,
        intensity_hidden=(16,),
        num_levels=2,
        max_range_m=70.0,
    )
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


def test_a_loaded_map_does_not_depend_on_its_file(saved, tmp_path):
    _, path, _, _ = saved
    copy = tmp_path / "map.safetensors"
    copy.write_bytes(path.read_bytes())
    radar_map = radarsdf.load(copy)
    x = np.array([[0.0, 0, 0]])
    expected = radar_map.sdf(x, extrapolate=True)
    copy.write_bytes(b"\0" * len(path.read_bytes()))
    assert radar_map.sdf(x, extrapolate=True) == expected
    assert not any(p.requires_grad for p in radar_map.field.parameters())


def test_the_file_is_plain_safetensors_with_units(saved):
    _, path, tensors, metadata = saved
    assert metadata["format"] == "radarsdf.map"
    assert metadata["format_version"] == "12"
    assert "positive in free space" in metadata["units"]
    assert {"origin", "leaf_keys", "field.cells.features"} <= set(tensors)
    with path.open("rb") as file:
        start = file.read(2)
    assert start != pickle.PROTO + b"\x04"
    assert start != b"PK"  # what torch.save writes: a zip of pickles


def test_loading_unpickles_nothing(saved, monkeypatch):
    def refuse(*_, **__):
        pytest.fail("the loader unpickles")

    monkeypatch.setattr(pickle, "load", refuse)
    monkeypatch.setattr(pickle, "loads", refuse)
    monkeypatch.setattr(torch, "load", refuse)
    radarsdf.load(saved[1])


@pytest.mark.parametrize("keep", [0, 1, 7, 8, 9, 500, 0.5, 0.99, -1])
def test_truncated_files(saved, tmp_path, keep):
    data = saved[1].read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(data[: int(len(data) * keep) if isinstance(keep, float) else keep])
    with pytest.raises(ValueError, match=r"cut\.safetensors is not a whole radarsdf map"):
        radarsdf.load(path)


@pytest.mark.parametrize(
    "content", [b"\xff" * 64, b"PK\x03\x04" + b"\0" * 60, b"ply\nformat ascii 1.0\n", b"\x80\x04N."]
)
def test_garbage(tmp_path, content):
    path = tmp_path / "garbage.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"garbage\.safetensors is not a whole radarsdf map"):
        radarsdf.load(path)


def test_files_of_other_programs(tmp_path):
    for metadata in (None, {"format": "pt"}, {"format": "radarsdf.mesh", "format_version": "1"}):
        save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors", metadata)
        with pytest.raises(ValueError, match="is not a radarsdf map"):
            radarsdf.load(tmp_path / "other.safetensors")


@pytest.mark.parametrize("version", ["4", "9", "11", "13", "", "1.5", "-1", "one"])
def test_other_versions(saved, tmp_path, version):
    _, _, tensors, metadata = saved
    path = write(tmp_path / "new.safetensors", tensors, metadata | {"format_version": version})
    with pytest.raises(ValueError, match="format version"):
        radarsdf.load(path)


def test_confidence_survives_the_file(saved):
    radar_map, path, _, _ = saved
    x = np.random.default_rng(0).uniform([8, -6, -0.3], [20, 6, 0.3], (1000, 3))
    confidence = radarsdf.load(path).confidence(x)
    np.testing.assert_array_equal(confidence, radar_map.confidence(x))
    assert confidence.max() > 0.3


@pytest.mark.parametrize("fault", ["missing", "longer", "flat", "float64", "int64", "int32"])
@pytest.mark.parametrize("name", ["information", "detections", "looks"])
def test_evidence_of_another_shape_or_type(saved, tmp_path, name, fault):
    _, _, tensors, metadata = saved
    changed = dict(tensors)
    match fault:
        case "missing":
            del changed[name]
        case "longer":
            changed[name] = torch.cat([tensors[name], tensors[name][-1:]])
        case "flat":
            changed[name] = tensors[name].reshape(1, -1)
        case _:
            changed[name] = tensors[name].to(getattr(torch, fault))
    with pytest.raises(ValueError, match=name):
        radarsdf.load(write(tmp_path / "wrong.safetensors", changed, metadata))


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_information_that_cannot_be(saved, tmp_path, value):
    _, _, tensors, metadata = saved
    information = tensors["information"].clone()
    information[5] = value
    path = write(tmp_path / "wrong.safetensors", tensors | {"information": information}, metadata)
    with pytest.raises(ValueError, match="information"):
        radarsdf.load(path)


@pytest.mark.parametrize("value", [-0.01, 1.01, math.nan, math.inf, "much", None, [0.1]])
def test_rough_shares_that_cannot_be(saved, tmp_path, value):
    _, _, tensors, metadata = saved
    spoilt = with_description(metadata, lambda d: d.update(rough_share=value))
    with pytest.raises(ValueError, match="is not a whole radarsdf map"):
        radarsdf.load(write(tmp_path / "wrong.safetensors", tensors, spoilt))


@pytest.mark.parametrize("value", [-0.01, math.nan, math.inf, "many", None, [2.5]])
def test_returns_per_cell_that_cannot_be(saved, tmp_path, value):
    _, _, tensors, metadata = saved
    spoilt = with_description(metadata, lambda d: d.update(returns_per_cell=value))
    with pytest.raises(ValueError, match="is not a whole radarsdf map"):
        radarsdf.load(write(tmp_path / "wrong.safetensors", tensors, spoilt))


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        radarsdf.load(tmp_path / "nothing.safetensors")
    with pytest.raises(ValueError, match=f"{tmp_path} is no map"):
        radarsdf.load(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["field.cells.features", "field.sdf_network.layers.0.weight", "origin"])
def test_values_that_are_not_finite(saved, tmp_path, name, value):
    _, _, tensors, metadata = saved
    damaged = tensors[name].clone()
    damaged.view(-1)[-1] = value
    path = write(tmp_path / "nan.safetensors", tensors | {name: damaged}, metadata)
    with pytest.raises(ValueError, match="finite"):
        radarsdf.load(path)


@pytest.mark.parametrize(
    "name", ["field.cells.features", "field.sdf_network.layers.2.bias", "origin", "leaf_keys"]
)
@pytest.mark.parametrize("fault", ["missing", "longer", "flat", "half"])
def test_tensors_that_do_not_fit(saved, tmp_path, name, fault):
    _, _, tensors, metadata = saved
    changed = dict(tensors)
    match fault:
        case "missing":
            del changed[name]
        case "longer":
            changed[name] = torch.cat([tensors[name], tensors[name][-1:]])
        case "flat":
            changed[name] = tensors[name].reshape(1, -1)
        case "half":
            changed[name] = tensors[name].half()
    with pytest.raises(ValueError, match=r"."):
        radarsdf.load(write(tmp_path / "bad.safetensors", changed, metadata))


def test_a_tensor_too_many(saved, tmp_path):
    _, _, tensors, metadata = saved
    path = write(tmp_path / "more.safetensors", tensors | {"field.extra": torch.zeros(2)}, metadata)
    with pytest.raises(ValueError, match="extra"):
        radarsdf.load(path)


@pytest.mark.parametrize("keys", [[5, 5], [7, 5], [-1, 3], [2**62]])
def test_cells_that_cannot_be(saved, tmp_path, keys):
    _, _, tensors, metadata = saved
    path = write(tmp_path / "keys.safetensors", tensors | {"leaf_keys": torch.tensor(keys)}, metadata)
    with pytest.raises(ValueError, match=r"."):
        radarsdf.load(path)


DAMAGE = {
    "unknown setting": lambda d: d["config"].update(colour="red"),
    "unknown setting of a group": lambda d: d["config"]["training"].update(colour="red"),
    "a group a list": lambda d: d["config"].update(training=[1, 2]),
    "a group null": lambda d: d["config"].update(training=None),
    "setting out of range": lambda d: d["config"].update(leaf_size_m=-0.2),
    "setting of another type": lambda d: d["config"]["training"].update(batch_size="many"),
    "fractional count": lambda d: d["config"]["encoding"].update(num_levels=2.5),
    "number beyond floats": lambda d: d["config"]["training"].update(sigma_cells=10**400),
    "other levels": lambda d: d["config"]["encoding"].update(num_levels=5),
    "other width": lambda d: d["config"]["networks"].update(intensity_hidden=[65, 64, 64]),
    "no config": lambda d: d.pop("config"),
    "config a list": lambda d: d.update(config=[1, 2]),
    "no report": lambda d: d.pop("report"),
    "report a number": lambda d: d.update(report=3),
    "no rough share": lambda d: d.pop("rough_share"),
    "no returns per cell": lambda d: d.pop("returns_per_cell"),
    "no scale": lambda d: d.pop("intensity_scale"),
    "scale of one number": lambda d: d.update(intensity_scale=[1.0]),
    "scale a word": lambda d: d.update(intensity_scale=["low", "high"]),
    "scale not a number": lambda d: d.update(intensity_scale=[float("nan"), 1.0]),
    "scale upside down": lambda d: d.update(intensity_scale=[2.0, 1.0]),
    "scale beyond floats": lambda d: d.update(intensity_scale=[10**400, 1]),
    "intensity without weights": lambda d: d.update(intensity_scale=None),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_descriptions_that_do_not_fit(saved, tmp_path, damage):
    _, _, tensors, metadata = saved
    path = write(tmp_path / "bad.safetensors", tensors, with_description(metadata, DAMAGE[damage]))
    with pytest.raises(ValueError, match=r"."):
        radarsdf.load(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", "[" * 100_000])
def test_descriptions_that_are_none(saved, tmp_path, text):
    _, _, tensors, metadata = saved
    with pytest.raises(ValueError, match="is not a whole radarsdf map"):
        radarsdf.load(write(tmp_path / "bad.safetensors", tensors, metadata | {"description": text}))
    without = {k: v for k, v in metadata.items() if k != "description"}
    with pytest.raises(ValueError, match="is not a whole radarsdf map"):
        radarsdf.load(write(tmp_path / "none.safetensors", tensors, without))


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failing_save_leaves_the_old_file_and_nothing_else(saved, tmp_path, monkeypatch, failing):
    radar_map = saved[0]
    path = tmp_path / "map.safetensors"
    path.write_bytes(b"the old map")

    def fail(*_):
        msg = "no space left on device"
        raise OSError(msg)

    if failing == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        monkeypatch.setattr(files.Path, "replace", fail)
    with pytest.raises(OSError, match="no space left"):
        radar_map.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]
    assert path.read_bytes() == b"the old map"


def test_saving_where_nothing_can_be_written(saved, tmp_path):
    radar_map = saved[0]
    with pytest.raises(OSError, match="absent"):
        radar_map.save(tmp_path / "absent" / "map.safetensors")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        radar_map.save(tmp_path / "folder")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]
    assert not list((tmp_path / "folder").iterdir())


@pytest.mark.skipif(os.name != "posix", reason="POSIX permissions")
def test_a_saved_map_has_the_permissions_of_any_new_file(saved, tmp_path):
    before = os.umask(0o027)
    try:
        saved[0].save(tmp_path / "map.safetensors")
        (tmp_path / "other").write_bytes(b"")
    finally:
        os.umask(before)
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("map.safetensors", "other")]
    assert modes == [0o640, 0o640]


def test_saving_overwrites_and_takes_strings(saved, tmp_path):
    path = str(tmp_path / "map.safetensors")
    for _ in range(2):
        saved[0].save(path)
    assert os.listdir(tmp_path) == ["map.safetensors"]  # noqa: PTH208 - a string is the point
    assert repr(radarsdf.load(path)) == repr(saved[0])


@pytest.fixture(scope="module")
def saved_closed_form(scene, tmp_path_factory):
    """A quick map with intensities, its file, and the file's parts."""
    config = FitConfig.quick()
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    return saved_parts(radar_map, tmp_path_factory.mktemp("map"))


def test_intensities_in_closed_form_are_kept(scene, saved_closed_form):
    radar_map, path, _, _ = saved_closed_form
    points = scene.points[0] + scene.poses[0, :3, 3]
    expected = radar_map.intensity(points, SENSOR)
    assert np.nanstd(expected) > 0
    for other in (radarsdf.load(path), pickle.loads(pickle.dumps(radar_map))):
        np.testing.assert_array_equal(other.intensity(points, SENSOR), expected)


def test_what_the_network_leaves_is_added_and_kept(scene, tmp_path):
    alone, both = (fitted(scene, reflectance=answers) for answers in ("network", "both"))
    world = [
        scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(scene.points, scene.poses, strict=True)
    ]
    sensors = [np.broadcast_to(pose[:3, 3], x.shape) for x, pose in zip(world, scene.poses, strict=True)]
    asked = np.concatenate(world), np.concatenate(sensors)
    measured = np.concatenate(scene.intensities)
    errors = [
        np.abs(radar_map.intensity(*asked, extrapolate=True) - measured).mean() for radar_map in (alone, both)
    ]
    assert errors[1] < 0.9 * errors[0]
    both.save(tmp_path / "map.safetensors")
    again = radarsdf.load(tmp_path / "map.safetensors")
    np.testing.assert_array_equal(again.intensity(*asked), both.intensity(*asked))


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("reflectance.means", lambda t: t * math.nan),
        ("reflectance.means", lambda t: t[1:]),
        ("reflectance.coefficients", lambda t: t[1:]),
        ("reflectance.table", lambda t: t[1:]),
        ("reflectance.normals", lambda t: t.double()),
        ("reflectance.plane_keys", lambda t: t.flip(0)),
        ("reflectance.mean_keys", lambda t: t * 0),
    ],
)
def test_damaged_intensities_in_closed_form_are_refused(saved_closed_form, tmp_path, name, spoil):
    _, _, tensors, metadata = saved_closed_form
    spoilt = write(tmp_path / "map.safetensors", tensors | {name: spoil(tensors[name])}, metadata)
    with pytest.raises(ValueError, match="is not a whole radarsdf map"):
        radarsdf.load(spoilt)


def test_a_map_of_averages_keeps_a_distance_at_each_corner(tmp_path):
    scans = radarsdf.simulate.wall(frames=4)
    quick = radarsdf.fit(scans.points, scans.poses, config=FitConfig.quick(), progress=False)
    quick.save(tmp_path / "quick.safetensors")
    tensors = load_file(tmp_path / "quick.safetensors")
    assert tensors["field.distances_m"].shape == (quick.report["vertices"],)
    again = radarsdf.load(tmp_path / "quick.safetensors")
    assert again.field.distances_m.equal(quick.field.distances_m)
    assert again.nbytes == quick.nbytes == 4 * quick.report["vertices"]


def test_echoes_are_kept_bit_for_bit(scene, tmp_path):
    radar_map, path, tensors, metadata = saved_parts(fitted(scene, returns={"passages": True}), tmp_path)
    loaded, expected = radarsdf.load(path).echoes(), radar_map.echoes()
    assert len(expected.counts) > 100
    for name in ("points", "directions", "ranges_m", "intensities", "counts"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(expected, name))
    assert loaded.sigma == expected.sigma > 0
    for name, wrong, what in (
        ("counts", torch.zeros_like(tensors["echoes.counts"]), "the echoes hold numbers out of range"),
        ("points", tensors["echoes.points"][:-1], "the echoes have arrays of wrong shapes"),
        (
            "intensities",
            tensors["echoes.intensities"] * math.nan,
            "intensities of the echoes is not .* finite",
        ),
        ("directions", tensors["echoes.directions"].to(torch.int16), r"directions of .* torch\.int8"),
    ):
        write(path, tensors | {f"echoes.{name}": wrong}, metadata)
        with pytest.raises(ValueError, match=f"is not a whole radarsdf map: {what}"):
            radarsdf.load(path)
