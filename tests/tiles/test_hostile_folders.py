"""Damaged and malicious folders of tiles: the fault is named, and no other file is changed."""

import json
import shutil

import numpy as np
import pytest
import radarsdf
from radarsdf.tiles.plan import Plan, failure_path, map_path

from ..cli.calls import refusal

WILD = [
    None, True, -1, 1.5, 10**400, 1e308, float("nan"), "", "../../x", "\x1b[2J", [], [[]], ["0", "x/../../../v"], {},
]  # fmt: skip


@pytest.fixture
def copy(folder, tmp_path):
    """A copy of a folder of tiles, to be damaged."""
    return shutil.copytree(folder, tmp_path / "city")


def test_a_tile_cannot_be_named_by_a_path(copy, tmp_path, capsys):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "failed.txt").write_text("secret")
    plan = json.loads((copy / "plan.json").read_text())
    (copy / "tiles" / "0_x").mkdir()
    plan["tiles"][0]["tile"] = ["0", "x/../../../victim"]
    (copy / "plan.json").write_text(json.dumps(plan))
    for words in (["status"], ["fit"], ["mesh"]):
        said = refusal(capsys, copy, "tiles", *words, copy)
        assert "plan.json is not a complete plan" in said
        assert "secret" not in said
    assert [(path.name, path.read_text()) for path in victim.iterdir()] == [("failed.txt", "secret")]


def test_types_of_a_plan_are_checked(copy):
    path = copy / "plan.json"
    whole = json.loads(path.read_text())
    refused = 0
    for name in [*whole, *whole["tiles"][0]]:
        for wild in WILD:
            plan = json.loads(json.dumps(whole))
            (plan if name in whole else plan["tiles"][0])[name] = wild
            path.write_text(json.dumps(plan))
            try:
                loaded = Plan.load(copy)
            except ValueError as error:
                assert str(error).startswith(f"{path} is not a complete plan: ")  # noqa: PT017
                refused += 1
            else:
                assert all(map_path(copy, tile).parent.parent == copy / "tiles" for tile in loaded.tiles)
    assert refused > 150


def test_control_characters_of_a_reason_are_escaped(copy):
    tile = Plan.load(copy).tiles[0]
    map_path(copy, tile).unlink()
    failure_path(copy, tile).write_bytes(b"\x1b[2J\x1b]0;x\x07gone\nnext\xff" + b"x" * 10**6)
    reason = radarsdf.load(copy).missing[tile.name]
    assert reason.isprintable()
    assert "gone next" in reason
    assert len(reason) <= 10_000


def test_damaged_parts_of_a_mesh_are_rejected(copy):
    for part in copy.rglob("mesh-*.npz"):  # of other settings
        part.unlink()
    radarsdf.load(copy).mesh(0.2, progress=False)
    path = max(copy.rglob("mesh-*.npz"), key=lambda file: file.stat().st_size)
    with np.load(path) as file:
        arrays = dict(file)
    for damaged in (arrays | {"faces": np.zeros((2, 2))}, {"vertices": arrays["vertices"]}):
        np.savez(path, **damaged)
        with pytest.raises(ValueError, match=f"{path.name} is not a complete"):
            radarsdf.load(copy).mesh(0.2, progress=False)


def test_a_map_in_the_place_of_another_is_missing(copy):
    first, second = Plan.load(copy).tiles[:2]
    shutil.copyfile(map_path(copy, second), map_path(copy, first))
    assert list(radarsdf.load(copy).missing) == [first.name]


def test_flipped_bits_of_a_plan_are_detected(copy):
    path, rng = copy / "plan.json", np.random.default_rng(0)
    whole = path.read_bytes()
    for _ in range(40):
        content = bytearray(whole)
        content[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"plan\.json"):
            radarsdf.load(copy)
