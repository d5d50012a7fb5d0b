"""Two drives through one place: in between, one box is removed and another is added."""

from dataclasses import replace

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.changes.alignment import align
from radarsdf.changes.changes import APPEARED, GONE, UNSEEN
from radarsdf.changes.probability import PlacedMap
from radarsdf.cli import main
from radarsdf.poses.rigid import transform
from radarsdf.simulate import Box
from radarsdf.simulate.materials import CONCRETE

from scenes.revisits import SYMMETRIC, another_day

from .conftest import QUICK, drives_past

TAKEN, PUT = np.array([2.5, 2.5, 0.5]), np.array([2.5, -3.0, 0.5])


def box(center):
    return Box(center, np.full(3, 0.5), 0.3, CONCRETE)


@pytest.fixture(scope="module")
def drives():
    """A drive past a wall, one without changes, and one after them."""
    return drives_past([box(TAKEN)], [box(PUT)])


def shares(surface, kind, center):
    """Share of a box's area of a kind of change, and area of that kind elsewhere, m²."""
    kinds, areas = surface.of_faces()
    away = np.linalg.norm(surface.vertices[surface.faces].mean(axis=1)[:, :2] - center[:2], axis=1)
    on = away < 1.0
    raised = surface.vertices[surface.faces].mean(axis=1)[:, 2] > 0.35
    there = on & raised
    return areas[there & (kinds == kind)].sum() / areas[there].sum(), areas[~on & (kinds > 0)].sum()


def test_removed_and_added_objects_are_the_only_changes(changes):
    gone, beside = shares(changes.before, GONE, TAKEN)
    appeared, beside_after = shares(changes.after, APPEARED, PUT)
    assert gone > 0.6
    assert appeared > 0.6
    assert beside + beside_after < 0.005 * changes.report["compared_m2"]
    first = changes.regions()[:2]
    assert {region.kind for region in first} == {"gone", "appeared"}


def test_repeated_drives_through_a_scene_have_no_changes(maps):
    same = radarsdf.compare(maps[0], maps[1])
    assert sum(same.report["areas_m2"].values()) < 0.005 * same.report["compared_m2"]


def test_surfaces_unobserved_by_the_later_drive_are_not_gone(drives, maps):
    # The drive after the change, without rays near the place of the box.
    drive = drives[2]
    scans = [
        scan[_clear_of(TAKEN, T, scan @ T[:3, :3].T + T[:3, 3])]
        for scan, T in zip(drive.points, drive.poses, strict=True)
    ]
    found = radarsdf.compare(maps[0], scans, drive.poses)
    kinds, areas = found.before.of_faces()
    away = np.linalg.norm(found.before.vertices[found.before.faces].mean(axis=1) - TAKEN, axis=1)
    hidden = away < 0.9
    assert areas[hidden].sum() > 2
    assert areas[hidden & (kinds == GONE)].sum() < 0.02 * areas[hidden].sum()
    assert areas[hidden & (kinds == UNSEEN)].sum() > 0.8 * areas[hidden].sum()


def _clear_of(center, T, ends):
    """Mask of rays that stay at least 1.3 m away from a place."""
    rays, to_center = ends - T[:3, 3], center - T[:3, 3]
    share = np.clip(rays @ to_center / (rays**2).sum(axis=1), 0, 1)
    return np.linalg.norm(share[:, None] * rays - to_center, axis=1) > 1.3


def test_maps_of_different_frames_are_aligned_first(drives, maps):
    apart = transform(np.array([0.0, 0.0, 0.03]), np.array([0.4, -0.3, 0.1]))
    drive = drives[2]
    found = radarsdf.compare(maps[0], drive.points, apart @ drive.poses, drive.intensities)
    assert "moved" in found.report["alignment"]
    x = np.append(PUT, 1)
    # The offset along the wall is unobservable.
    assert np.abs(found.T_before_after @ apart @ x - x)[[0, 2]].max() < 0.1


def test_maps_of_unrelated_frames_are_compared():
    first = radarsdf.simulate.oculii(seed=1, frames=40)
    day, apart = another_day(first, 1), transform(np.array([0.0, 0.0, 2.0]), np.array([50.0, 20.0, 3.0]))
    before = radarsdf.fit(first.points, first.poses, config=QUICK)
    found = radarsdf.compare(before, day.points, apart @ day.poses)
    np.testing.assert_allclose((found.T_before_after @ apart)[:3, :3], np.eye(3), atol=0.01)
    moved_m = (found.T_before_after @ apart @ day.poses - day.poses)[:, :3, 3]
    np.testing.assert_allclose(moved_m, 0, atol=0.05)


@pytest.mark.parametrize("name", list(SYMMETRIC))
def test_another_place_that_fits_is_named(name):
    first = SYMMETRIC[name](seed=2, frames=30)
    before, day = radarsdf.fit(first.points, first.poses, config=QUICK), another_day(first, 2)
    words = radarsdf.compare(before, day.points, day.poses).report["alignment"]
    assert "two places of the map fit about equally well" in words


@pytest.fixture(scope="module")
def wall_alone(maps):
    """Two maps of a wall and the ground, the later one without surfaces that face along the wall."""
    before, after = (PlacedMap.of(radar_map) for radar_map in maps[:2])
    along = np.abs(after.normals[after.faces, 1]).max(axis=1)
    return before, replace(after, faces=after.faces[along < 0.15])


def test_a_wall_is_aligned_only_along_its_normal(wall_alone):
    (before, after), shift_m = wall_alone, (-0.7, 0.5, 0.1)
    found = align(before, replace(after, vertices=after.vertices + shift_m))
    moved_m = found.T_before_after[:3, 3] + (found.T_before_after[:3, :3] - np.eye(3)) @ found.centre
    np.testing.assert_allclose(moved_m, [-shift_m[0], 0, -shift_m[2]], atol=0.05)


@pytest.mark.parametrize("shift_m", [(0, 0, 0), (0, 0.3, 0)], ids=str)
def test_frames_without_a_significant_offset_are_kept(wall_alone, shift_m):
    before, after = wall_alone
    found = align(before, replace(after, vertices=after.vertices + shift_m))
    np.testing.assert_array_equal(found.T_before_after, np.eye(4))


def test_a_map_without_a_surface_is_named_in_the_error(maps):
    two = [np.array([[5.0, 0, 0], [5.0, 0.3, 0.1]])]
    with pytest.raises(ValueError, match="after has no surface"):
        radarsdf.compare(maps[0], two, [np.eye(4)])
    empty = radarsdf.fit(two, [np.eye(4)], config=QUICK)
    with pytest.raises(ValueError, match="before has no surface"):
        radarsdf.compare(empty, maps[0])


@pytest.mark.parametrize(
    ("turn_rad", "shift_m", "said"),
    [(np.pi / 9, 0, "of the steep surfaces"), (0, 200, "no surface in common")],
    ids=["turned", "elsewhere"],
)
def test_incompatible_maps_are_rejected(drives, maps, turn_rad, shift_m, said):
    apart = transform(np.array([0.0, 0.0, turn_rad]), np.array([shift_m, 0.0, 0.0]))
    with pytest.raises(ValueError, match=said):
        radarsdf.compare(maps[0], drives[1].points, apart @ drives[1].poses, align_frames=False)


def test_a_box_around_a_change_has_only_that_change(changes, maps):
    """Although most of its contents changed: change rates are estimated from whole maps."""
    around = np.stack([TAKEN - [0.7, 0.7, 0.1], TAKEN + 0.7])
    found = radarsdf.compare(maps[0], maps[2], box=around)
    assert {region.kind for region in found.regions(0.1)} == {"gone"}
    assert ((found.before.vertices >= around[0]) & (found.before.vertices <= around[1])).all()
    np.testing.assert_array_equal(found.T_before_after, changes.T_before_after)
    assert 0 < found.report["compared_m2"] < 0.1 * changes.report["compared_m2"]


def test_files_contain_the_changes(changes, maps, tmp_path, capsys):
    for number, name in ((0, "a"), (2, "b")):
        maps[number].save(tmp_path / f"{name}.safetensors")
    out = tmp_path / "changes.ply"
    arguments = ["compare", *(str(tmp_path / f"{n}.safetensors") for n in "ab"), "-o", str(out)]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    for region in changes.regions(0.1)[:10]:
        assert f"{region.area_m2:.2f}" in said
        assert f"{region.probability:.2f}" in said
    mesh, expected = trimesh.load(out, process=False), changes.mesh()
    np.testing.assert_array_equal(mesh.visual.vertex_colors, expected.visual.vertex_colors)
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) >= 3


def test_maps_without_free_space_and_bad_poses_are_rejected(maps, drives):
    drive = drives[0]
    blind = radarsdf.fit(drive.points[:4], drive.poses[:4], config=radarsdf.FitConfig.quick())
    with pytest.raises(ValueError, match="after has no free-space crossings"):
        radarsdf.compare(maps[0], blind)
    with pytest.raises(ValueError, match="a map has its own"):
        radarsdf.compare(maps[0], maps[1], drive.poses)
