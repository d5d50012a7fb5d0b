"""Two drives through one place: in between, the reflectance of boxes changes."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.changes.changes import REFLECTANCE_CHANGED, UNSEEN
from radarsdf.poses.rigid import transform
from radarsdf.simulate import Box
from radarsdf.simulate.materials import CONCRETE

from .conftest import QUICK, drives_past

STRONGER, WEAKER, KEPT = (np.array([2.5, y, 0.5]) for y in (2.8, -0.2, -3.2))
STRONGER_DB, GAIN_DB = 8.0, 5.0


def box(center, more_db=0.0):
    material = dataclasses.replace(CONCRETE, reflectivity_db=CONCRETE.reflectivity_db + more_db)
    return Box(center, np.full(3, 0.5), 0.3, material)


@pytest.fixture(scope="module")
def drives():
    """A drive past a wall with three boxes, one without changes, and one after the reflectance of two changed."""
    return drives_past(*([box(STRONGER, more), box(WEAKER, -more), box(KEPT)] for more in (0.0, STRONGER_DB)))


def on_box(surface, center):
    """Share of a box's area with changed reflectance, and its median change of intensity."""
    kinds, areas = surface.of_faces()
    middle = surface.vertices[surface.faces].mean(axis=1)
    on = (np.abs(box(center).signed_distance(middle)) < 0.15) & (middle[:, 2] > 0.3)
    change = np.nanmedian(surface.intensity_change[np.unique(surface.faces[on])])
    return areas[on & (kinds == REFLECTANCE_CHANGED)].sum() / areas[on].sum(), change


def test_changed_reflectance_is_the_only_change_found(changes):
    for center, more in ((STRONGER, STRONGER_DB), (WEAKER, -STRONGER_DB)):
        share, change = on_box(changes.after, center)
        assert share > 0.7
        assert abs(change - more) < 2.0
    assert on_box(changes.after, KEPT)[0] == 0
    kinds, areas = changes.after.of_faces()
    middle = changes.after.vertices[changes.after.faces].mean(axis=1)
    away = np.min([box(center).signed_distance(middle) for center in (STRONGER, WEAKER)], axis=0) > 0.6
    assert areas[away & (kinds == REFLECTANCE_CHANGED)].sum() < 0.005 * areas[away & (kinds != UNSEEN)].sum()
    found = [region for region in changes.regions(0.5) if region.kind == "reflectance_changed"]
    assert len(found) == 2
    assert min(region.probability for region in found) > 0.8
    assert sum(region.area_m2 for region in found) > 2
    every = sum(region.area_m2 for region in changes.regions() if region.kind == "reflectance_changed")
    assert changes.report["areas_m2"]["reflectance_changed"] == pytest.approx(every)


def test_repeated_drives_have_no_changed_reflectance(maps):
    same = radarsdf.compare(maps[0], maps[1])
    assert same.report["areas_m2"]["reflectance_changed"] < 0.0025 * same.report["compared_m2"]
    assert abs(same.report["intensity_offset"]) < 0.2


def test_another_gain_and_another_frame_are_no_change(drives, maps):
    apart = transform(np.array([0.0, 0.0, 0.03]), np.array([0.4, -0.3, 0.1]))
    drive = drives[1]
    louder = [intensities + GAIN_DB for intensities in drive.intensities]
    other = radarsdf.fit(drive.points, apart @ drive.poses, louder, config=QUICK)
    found = radarsdf.compare(maps[0], other)
    assert "moved" in found.report["alignment"]
    assert abs(found.report["intensity_offset"] - GAIN_DB) < 0.3
    assert found.report["areas_m2"]["reflectance_changed"] < 0.0025 * found.report["compared_m2"]


def test_without_intensities_no_reflectance_change_is_reported(drives, maps):
    blind = radarsdf.fit(drives[2].points, drives[2].poses, config=QUICK)
    found = radarsdf.compare(maps[0], blind)
    assert len(blind.view_statistics().counts) == 0
    assert found.report["intensity_offset"] is None
    assert np.isnan(found.after.intensity_change).all()
    assert found.report["areas_m2"]["reflectance_changed"] == 0


@pytest.mark.parametrize(
    "units", [lambda db: 10 ** (db / 10), lambda db: 2 * db], ids=["power", "half decibels"]
)
def test_intensities_in_other_units_are_not_compared(drives, maps, units):
    drive = drives[1]
    other = radarsdf.fit(drive.points, drive.poses, [units(db) for db in drive.intensities], config=QUICK)
    for before, after in ((maps[0], other), (other, maps[0])):
        found = radarsdf.compare(before, after, align_frames=False)
        assert "other units" in found.report["reflectance"]
        assert found.report["intensity_offset"] is None
        assert found.report["areas_m2"]["reflectance_changed"] == 0
        assert found.report["compared_m2"] > 100
