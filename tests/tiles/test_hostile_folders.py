# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Folders of tiles that come from elsewhere: nothing is written outside of them, and what is wrong is said in a line."""

from __future__ import annotations

import io
import json
import os
import shutil

import numpy as np
import pytest
import radarsdf
from radarsdf.map.storage import checked_report
from radarsdf.tiles.fit_tiles import run_fits
from radarsdf.tiles.pieces import Piece
from radarsdf.tiles.plan import Plan, failure_of, failure_path, map_path
from radarsdf.tiles.ray_files import rays_path, read_rays
from radarsdf.tiles.tile_fit import report_of

from ..cli.calls import refusal

WILD = [
    None, True, False, -1, 0, 1.5, 10**400, 2**63, -(2**63), 1e308, float("nan"), float("inf"), "", "0", "../../x", "/etc/x",
    "\x1b[2J", [], [[]], [1], ["0", "x/../../../victim"], [0, 0, 0, 0], [1e30, 0], [2**62, 2**62], [float("nan")] * 2, {},
    {"a": {}}, "x" * 5000,
]  # fmt: skip


@pytest.fixture
def copy(folder, tmp_path):
    """A folder of tiles that may be spoilt."""
    return shutil.copytree(folder, tmp_path / "city")


def changed(plan, path, value):
    plan = json.loads(json.dumps(plan))
    *ways, last = path
    place = plan
    for step in ways:
        place = place[step]
    place[last] = value
    return plan


def places(value, path=()):
    """The paths of all values in a value of JSON, of lists to the first entry."""
    if path:
        yield path
    inner = (
        value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    )
    for name, part in inner:
        yield from places(part, (*path, name))


def test_a_tile_cannot_be_named_by_a_path(copy, tmp_path, capsys):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "failed.txt").write_text("secret")
    plan = json.loads((copy / "plan.json").read_text())
    (copy / "tiles" / "0_x").mkdir()
    (copy / "plan.json").write_text(
        json.dumps(changed(plan, ("tiles", 0, "tile"), ["0", "x/../../../victim"]))
    )
    for words in (["status"], ["fit"], ["mesh"], ["clean"]):
        said = refusal(capsys, copy, "tiles", *words, copy)
        assert f"{copy / 'plan.json'} is not a whole plan: tileplan.tile must be" in said
        assert "secret" not in said
    assert (victim / "failed.txt").read_text() == "secret"
    assert [path.name for path in victim.iterdir()] == ["failed.txt"]


def test_each_field_of_a_plan_is_checked(copy):
    path = copy / "plan.json"
    plan = json.loads(path.read_text())
    refused = 0
    for i, place in enumerate(places(plan)):
        for wild in (
            WILD if place[0] != "config" else WILD[i % 8 :: 8]
        ):  # the settings have tests of their own
            path.write_text(json.dumps(changed(plan, place, wild)))
            try:
                loaded = Plan.load(copy)
            except ValueError as error:
                assert str(error).startswith(f"{path} is not a whole plan: ")  # noqa: PT017
                assert "\n" not in str(error)  # noqa: PT017
                assert len(str(error)) < 500 + len(str(path))  # noqa: PT017
                refused += 1
            else:
                for tile in loaded.tiles:
                    assert all(type(number) is int for number in tile.tile)
                    assert map_path(copy, tile).parent.parent == copy / "tiles"
                    assert np.isfinite(loaded.config.lattice.position(tile.origin_cells)).all()
    assert refused > 400


@pytest.mark.parametrize("text", ["", "[]", "null", "1", "{}", "[" * 5000, '{"format": 1}', "\xff", "NaN"])
def test_a_plan_that_is_none(copy, text):
    (copy / "plan.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match="is not a whole plan: "):
        Plan.load(copy)


def test_values_of_a_plan_that_contradict_each_other(copy):
    plan = json.loads((copy / "plan.json").read_text())
    for place, wild in {
        ("tiles",): [plan["tiles"][0]] * 2,
        ("tile_m",): plan["tile_m"] + 0.1,
        ("halo_m",): 2 * plan["tile_m"],
        ("tiles", 0, "scans"): [0, plan["scans"]],
        ("tiles", 0, "origin_cells"): [1, 0, 0],
        ("tiles", 0, "tile"): [2**52, 0],
    }.items():
        (copy / "plan.json").write_text(json.dumps(changed(plan, place, wild)))
        with pytest.raises(ValueError, match=r"plan\.json is not a whole plan: plan\."):
            Plan.load(copy)


@pytest.mark.parametrize("what", ["tiles", "tile", "map", "failed", "rays", "scans", "plan"])
def test_a_link_does_not_lead_out(copy, tmp_path, what):
    plan = Plan.load(copy)
    tile = plan.tiles[0]
    place = {
        "tiles": copy / "tiles",
        "tile": map_path(copy, tile).parent,
        "map": map_path(copy, tile),
        "failed": failure_path(copy, tile),
        "rays": rays_path(copy, tile.tile),
        "scans": copy / "scans.npy",
        "plan": copy / "plan.json",
    }[what]
    outside = tmp_path / "outside"
    if place.exists():
        shutil.move(place, outside)
    else:
        outside.write_text("secret")
    place.symlink_to(outside)
    before = {path: path.stat().st_mtime_ns for path in [outside, *outside.rglob("*")]}
    if what not in ("map", "plan", "tiles", "tile"):
        map_path(copy, tile).unlink()  # so that it is fitted again
        if what == "failed":
            with pytest.raises(ValueError, match="is a link that leads out of"):
                failure_of(copy, tile)
    if what in ("rays", "scans"):
        assert "is a link that leads out of" in run_fits(copy, progress=False).missing[tile.name]
    else:
        with pytest.raises(ValueError, match="is a link that leads out of"):
            run_fits(copy, progress=False).missing  # noqa: B018 - it reads
    assert before == {path: path.stat().st_mtime_ns for path in [outside, *outside.rglob("*")]}


def test_the_folder_itself_may_be_a_link(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    assert len(radarsdf.load(tmp_path / "link").tiles) == len(radarsdf.load(folder).tiles)


def test_a_reason_is_printed_as_letters(copy):
    plan = Plan.load(copy)
    tile = plan.tiles[0]
    map_path(copy, tile).unlink()
    failure_path(copy, tile).write_bytes(b"\x1b[2J\x1b]0;x\x07gone\nnext\xff" + b"x" * 10**6)
    reason = radarsdf.load(copy).missing[tile.name]
    assert reason.isprintable()
    assert "gone next" in reason
    assert len(reason) <= 10_000


def test_a_folder_may_have_any_name(folder, tmp_path):
    path = tmp_path / os.fsdecode(b"\xff\xfe")
    try:
        path.mkdir()
    except OSError:
        pytest.skip("names are text here")
    shutil.copytree(folder, path / "city")
    city, same = radarsdf.load(path / "city"), radarsdf.load(folder)
    x = np.array([[5.0, 0.0, 1.0]])
    np.testing.assert_array_equal(city.sdf(x), same.sdf(x))
    assert city.report["returns"] == same.report["returns"]


def test_rays_that_are_damaged_are_refused(copy):
    plan = Plan.load(copy)
    tile = plan.tiles[0]
    path = rays_path(copy, tile.tile)
    data = path.read_bytes()
    for wild in (np.nan, np.inf, 1e38):
        path.write_bytes(np.array(wild, "<f4").tobytes() + data[4:])
        with pytest.raises(ValueError, match="other than finite positions"):
            read_rays(copy, plan, tile)
    path.write_bytes(data[:-4] + np.array(np.nan, "<f4").tobytes())
    with pytest.raises(ValueError, match="intensity that is not finite"):
        read_rays(copy, plan, tile)
    path.write_bytes(data[:-1])
    with pytest.raises(ValueError, match="rays instead of"):
        read_rays(copy, plan, tile)
    path.write_bytes(data)
    scans = np.load(copy / "scans.npy")
    for wild in (
        scans * np.nan,
        scans[:, :5],
        scans.astype(object),
        scans.astype("S3"),
        scans.astype(complex),
    ):
        np.save(copy / "scans.npy", wild)
        with pytest.raises(ValueError, match=r"scans\.npy"):
            read_rays(copy, plan, tile)
    (copy / "scans.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(ValueError, match=r"scans\.npy is not a whole \.npy file"):
        read_rays(copy, plan, tile)


def test_pieces_that_are_damaged_are_refused(copy):
    city = radarsdf.load(copy)
    city.mesh(0.2, progress=False)
    path = max(copy.rglob("mesh-*.npz"), key=lambda file: file.stat().st_size)
    with np.load(path) as file:
        arrays = dict(file)
    count = len(arrays["vertices"])
    assert len(Piece.load(path).faces) > 0
    wild = [{name: np.zeros((2, 2))} for name in arrays] + [{name: None} for name in arrays]
    wild += [{"faces": arrays["faces"] + np.int32(count)}, {"faces": arrays["faces"] - np.int32(count)},
             {"border_rows": arrays["border_rows"] - count}, {"vertices": arrays["vertices"] * np.nan},
             {"confidence": arrays["confidence"][1:]}, {"border_edges": arrays["border_edges"][1:]}]  # fmt: skip
    for change in wild:
        data = io.BytesIO()
        np.savez(data, **{name: array for name, array in (arrays | change).items() if array is not None})
        path.write_bytes(data.getvalue())
        with pytest.raises(ValueError, match=f"{path.name} is not a whole"):
            radarsdf.load(copy).mesh(0.2, progress=False)


def test_a_map_of_another_tile_is_refused(copy):
    first, second = (map_path(copy, tile) for tile in Plan.load(copy).tiles[:2])
    shutil.copy(second, first)
    city = radarsdf.load(copy)
    with pytest.raises(ValueError, match="is not the map of this tile"):
        city.contents_of(city.tiles[0].tile)


def test_leaf_keys_that_are_damaged_are_refused(copy):
    path = map_path(copy, Plan.load(copy).tiles[0])
    data = path.read_bytes()
    for old, new in (
        (b'"leaf_keys"', b'"leaf_kexs"'),
        (b'"leaf_keys":{"dtype":"I64"', b'"leaf_keys":{"dtype":"F64"'),
    ):
        assert old in data
        path.write_bytes(data.replace(old, new))
        with pytest.raises(ValueError, match="is not a whole radarsdf map"):
            radarsdf.load(copy).num_cells  # noqa: B018 - it reads


def test_what_others_read_of_a_report_has_its_type(copy):
    report = report_of(copy, Plan.load(copy).tiles[0])
    assert checked_report(report) == report
    for name in ("noise", "losses", "skipped"):
        with pytest.raises(ValueError, match=f"report.{name}"):
            checked_report(report | {name: 3})
    with pytest.raises(ValueError, match="the report must be a mapping"):
        checked_report([])
