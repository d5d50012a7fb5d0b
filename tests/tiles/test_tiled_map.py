"""A map that evaluates many tiles as one."""

import pickle
import shutil

import numpy as np
import pytest
import radarsdf
from radarsdf import TiledMap
from radarsdf.fitting.surface_returns import SurfaceReturns
from radarsdf.map import queries
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN
from radarsdf.tiles.planning import read_rays

from .conftest import CONFIG, TILE_M


@pytest.fixture(scope="module")
def points(drive):
    return np.concatenate([scan.world_points for scan in drive])[::7]


@pytest.fixture(scope="module")
def whole(drive):
    return radarsdf.fit(drive, config=CONFIG, progress=False)


def test_queries_equal_those_of_one_map(city, whole, points):
    known = whole.observed(points) & city.observed(points)
    assert known.mean() > 0.95
    points = points[known]
    difference_m = np.abs(city.sdf(points) - whole.sdf(points))
    assert np.median(difference_m) < 1e-3
    assert np.quantile(difference_m, 0.99) < 0.03
    ratio = city.uncertainty(points) / whole.uncertainty(points)
    assert 0.9 < np.median(ratio) < 1.1
    difference = np.abs(city.confidence(points) - whole.confidence(points))
    assert np.median(difference) < 0.05
    gradients = city.gradient(points), whole.gradient(points)
    assert np.quantile(np.linalg.norm(gradients[0] - gradients[1], axis=1), 0.95) < 0.05


@pytest.mark.parametrize("extrapolate", [False, True])
def test_a_query_evaluates_each_position_once_in_a_tile(city, points, monkeypatch, extrapolate):
    x = np.concatenate([points, points[:50] + [0, 0, 3.0], [[np.nan, 0, 0]]])
    evaluated, plane = [], queries.plane
    monkeypatch.setattr(
        queries, "plane", lambda contents, at: evaluated.append(len(at)) or plane(contents, at)
    )
    sdf, gradient = city.sdf(x, extrapolate=extrapolate, return_gradient=True)
    shares = sum(len(share.rows) for share in city._shares(x))
    assert 0 < sum(evaluated) <= shares
    np.testing.assert_array_equal(sdf, city.sdf(x, extrapolate=extrapolate))
    assert (np.isfinite(sdf[:-1]) | ~city.observed(x[:-1]) & (not extrapolate)).all()
    np.testing.assert_array_equal(gradient, city.gradient(x, extrapolate=extrapolate))


def test_common_properties_equal_those_of_one_map(folder, city, whole, drive):
    plan = city.plan
    rays = [read_rays(folder, plan, tile)[0] for tile in plan.tiles]
    surfels, counts = [SurfaceReturns.of(part, CONFIG, 1).surfels for part in rays], list(map(len, rays))
    clutter_ratio = np.average([part.clutter_ratio() for part in surfels], weights=counts)
    assert plan.clutter_ratio == pytest.approx(clutter_ratio, rel=1e-6)
    assert plan.returns_per_cell == pytest.approx(whole._contents.returns_per_cell, rel=0.05)
    assert (city.num_cells, len(city.tiles)) == (
        pytest.approx(len(whole.field.table.leaf_keys()), rel=0.01),
        4,
    )
    np.testing.assert_allclose(city.extent, whole.extent, atol=0.21)
    for name in ("azimuth_rad", "elevation_rad", "range_m", "returns_per_scan", "thresholds"):
        np.testing.assert_allclose(
            getattr(city.sensor, name), getattr(whole.sensor, name), rtol=0.02, atol=0.02
        )
    known = [tile.returns for tile in plan.tiles]
    assert sum(known) == city.report["returns"] == whole.report["returns_used"] + whole.report["ghosts"]
    assert city.report["scans"] == whole.report["scans"] == len(drive)
    assert city.report["noise"] == pytest.approx(whole.report["noise"], rel=0.1)
    owners = plan.grid.tiles_of(np.concatenate([scan.world_points for scan in drive]))
    for planned in plan.tiles:
        assert planned.returns <= (owners == planned.tile).all(axis=1).sum()
        lower, upper = plan.box_cells(planned) + planned.origin_cells
        np.testing.assert_array_equal(lower[:2], np.array(planned.tile) * plan.tile_cells)
        np.testing.assert_array_equal(upper - lower, [plan.tile_cells] * 2 + [2 * MAX_CELLS_FROM_ORIGIN])


def test_neighbours_cover_half_a_halo_of_a_missing_tile(folder, city, points, tmp_path):
    shutil.copytree(folder, tmp_path / "city")
    gone = max(city.tiles, key=lambda tile: tile.returns)
    (tmp_path / "city" / "tiles" / gone.name / "map.safetensors").unlink()
    lacking = radarsdf.load(tmp_path / "city")
    grid = city.plan.grid
    owned = points[(grid.tiles_of(points) == gone.tile).all(axis=1)]
    own_m = np.column_stack([owned[:, :2] - grid.lower_corner(gone.tile)] * 2)
    to_border_m = np.minimum(own_m, TILE_M - own_m).min(axis=1)
    seen = lacking.observed(owned)
    assert not seen[to_border_m > grid.halo_m / 2].any()
    near = (to_border_m < grid.halo_m / 2 - 0.1) & city.observed(owned)
    assert seen[near].sum() > 20
    np.testing.assert_allclose(lacking.sdf(owned[seen]), city.sdf(owned[seen]), atol=0.1)


# The border itself, inside the overlap, and where weights start to rise.
@pytest.mark.parametrize("offset_m", [0.0, 1.7, 3.2, -3.2])
def test_distances_are_continuous_across_tiles(city, points, offset_m):
    # Points of the surface moved to or near the borders between tiles along y, which the wall crosses.
    border_m, step = np.round(points[:, 1] / TILE_M) * TILE_M, np.array([0, 1e-5, 0])
    near = np.abs(points[:, 1] - border_m - offset_m) < 0.3
    border = points[near].copy()
    border[:, 1] = border_m[near] + offset_m
    border = border[city.observed(border - step) & city.observed(border + step)]
    assert len(border) > 20
    assert np.abs(city.sdf(border + step) - city.sdf(border - step)).max() < 1e-3
    before, after = (city.intensity(border + sign * step, [0, 0, 1]) for sign in (-1, 1))
    seen = np.isfinite(before) & np.isfinite(after)  # within the measured elevations
    assert seen.sum() > 10
    assert np.median(np.abs(after - before)[seen]) < 0.01


def test_limited_memory_changes_no_bit(folder, city, points):
    small = TiledMap(folder, memory_bytes=1)
    np.testing.assert_array_equal(small.sdf(points), city.sdf(points))
    assert len(small._held) == 1
    assert len(city._held) == len(city.tiles)


def test_views_equal_those_of_one_map(city, whole, drive):
    one, other = (map_.render(drive.poses[5], whole.sensor) for map_ in (whole, city))
    assert len(other) == pytest.approx(len(one), rel=0.05)
    both = np.isfinite(one.beam_ranges_m) & np.isfinite(other.beam_ranges_m)
    assert both.sum() > 0.95 * np.isfinite(one.beam_ranges_m).sum()
    difference_m = np.abs(one.beam_ranges_m - other.beam_ranges_m)[both]
    assert np.median(difference_m) < 1e-3
    assert np.quantile(difference_m, 0.95) < 0.1
    away = np.eye(4)
    away[0, 3] = 1e6
    assert len(city.render(away)) == len(whole.render(away)) == 0


def test_pickles_and_words(city, points):
    copy = pickle.loads(pickle.dumps(city))
    np.testing.assert_array_equal(copy.sdf(points[:100]), city.sdf(points[:100]))
    assert repr(city) == "TiledMap(surface and reflectance, 4 of 4 tiles of 12.8 m)"


def test_a_copy_is_the_same_map(city, points, tmp_path):
    city.save(tmp_path / "copy")
    copy = radarsdf.load(tmp_path / "copy")
    np.testing.assert_array_equal(copy.sdf(points), city.sdf(points))
    np.testing.assert_array_equal(copy.intensity(points, [0, 0, 1]), city.intensity(points, [0, 0, 1]))
    assert copy.report == city.report
    with pytest.raises(FileExistsError):
        city.save(tmp_path / "copy")


def test_view_statistics_equal_those_of_one_map(drive, tmp_path):
    """Returns in the overlap of several tiles count once."""
    config = CONFIG.override(returns={"free_space": True})
    radarsdf.fit_tiles(drive, tmp_path / "city", tile_size=TILE_M, halo=6.4, config=config, progress=False)
    found = radarsdf.load(tmp_path / "city").view_statistics()
    expected = radarsdf.fit(drive, config=config, progress=False).view_statistics()
    # Means near a border may be on either side of it. If all tiles counted, there would be twice as many.
    assert abs(found.counts.sum() / expected.counts.sum() - 1) < 0.03
    weights = [view_statistics.counts / view_statistics.counts.sum() for view_statistics in (found, expected)]
    for name in ("intensities", "ranges_m"):
        means = [getattr(e, name) @ w for e, w in zip((found, expected), weights, strict=True)]
        np.testing.assert_allclose(*means, rtol=0.005)
    assert abs(found.sigma / expected.sigma - 1) < 0.03
