# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Grids of a plane and a wall: what is occupied, free and unknown, and what planners read."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.cli import main
from radarsdf.grids.costmap import Wheels

BOX = [[5.0, -5.03, -1.57], [22.0, 4.97, 4.43]]  # centres of voxels are on no face of a cell


@pytest.fixture(scope="module")
def grid(sharp_map):
    return sharp_map.grid(BOX, 0.2)


def test_surfaces_are_occupied_air_is_free_and_what_is_behind_is_unknown(grid):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(9, 18, 2000), rng.uniform(-4, 4, 2000), np.zeros(2000)])
    assert (grid.at(ground) == 0).mean() < 0.001
    assert (grid.at(ground) == 1).mean() > 0.9
    air = np.column_stack(
        [rng.uniform(8, 16, 2000), rng.uniform(-1.5, 1.5, 2000), rng.uniform(0.8, 1.3, 2000)]
    )
    assert (grid.at(air) == 0).mean() > 0.7
    below, behind = ground - [0, 0, 0.8], np.column_stack([np.full(2000, 21.2), ground[:, 1], air[:, 2]])
    assert (grid.at(np.concatenate([below, behind])) == -1).all()
    assert grid.at([[np.nan, 0, 0], [1e9, 0, 0]]).tolist() == [-1, -1]


def test_probabilities_agree_with_the_states(sharp_map):
    grid = sharp_map.grid(BOX, 0.2, occupied_from=0.8, free_to=0.02)
    known = grid.probability[np.isfinite(grid.probability)]
    assert 0 <= known.min() < known.max() <= 1
    assert grid.probability[grid.occupied].min() >= 0.8
    # Rays alone leave less than 0.02; a surface that is nearby adds to it.
    assert np.median(grid.probability[grid.free]) < 0.02


def test_a_voxel_that_a_surface_grazes_is_not_free():
    """No return is in it, for they were moved onto the surface, and rays pass it above the ground often enough."""
    drive = radarsdf.simulate.KINDS["tunnel"](seed=5, frames=12)
    config = radarsdf.FitConfig(num_threads=1)
    radar_map = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
    # The ground is the border of two voxels.
    lower = np.floor(drive.poses[6, :3, 3] / 0.2) * 0.2 - [12, 12, 2]
    grid = radar_map.grid([lower, lower + [24, 24, 3]], 0.2)
    assert (grid.at(drive.ground_truth) == 0).mean() < 0.0003
    assert grid.free.sum() * 0.2**3 > 190


def test_seven_scans_from_one_place_free_what_is_before_a_facade():
    """Rays that graze the ground pass cells that the field alone would put a cell behind it: it is longer than the distance."""
    drive = radarsdf.simulate.KINDS["facade"](seed=5, frames=21)
    config = radarsdf.FitConfig(num_threads=1)
    radar_map = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
    grid = radar_map.grid([[5, 0, -1], [25, 14.5, 5]], 0.2)
    assert grid.free.sum() * 0.2**3 > 500
    assert (grid.at(drive.ground_truth) == 0).mean() < 0.001


def test_a_saved_map_has_the_same_grid(grid, sharp_map, tmp_path):
    sharp_map.save(tmp_path / "map.safetensors")
    again = radarsdf.load(tmp_path / "map.safetensors").grid(BOX, 0.2)
    np.testing.assert_array_equal(again.state, grid.state)
    np.testing.assert_array_equal(again.probability, grid.probability)


def test_larger_voxels_are_free_only_throughout(grid, sharp_map):
    coarse = sharp_map.grid(BOX, 0.4)
    x, y, z = (n // 2 for n in grid.shape)
    parts = grid.state[: 2 * x, : 2 * y, : 2 * z].reshape(x, 2, y, 2, z, 2).transpose(0, 2, 4, 1, 3, 5)
    parts = parts.reshape(x, y, z, 8)
    np.testing.assert_array_equal(coarse.free[:x, :y, :z], (parts == 0).all(axis=-1))
    np.testing.assert_array_equal(coarse.occupied[:x, :y, :z], (parts == 1).any(axis=-1))


def test_distances_are_within_their_error_and_the_unknown_is_no_way_out(grid):
    field = grid.distances()
    x = grid.centres(grid.free)
    true = np.minimum(x[:, 2], 20 - x[:, 0])
    error = (field.occupied_m[grid.free] - true)[x[:, 0] > 9]  # before that, no ground was seen
    assert (np.abs(error) <= field.error_m).mean() > 0.95
    np.testing.assert_array_equal(field.not_free_m[~grid.free], 0)
    assert (field.not_free_m[grid.free] <= field.occupied_m[grid.free] + 1e-5).all()
    edge = np.minimum(x[:, 1] - grid.origin[1], grid.origin[1] + grid.shape[1] * 0.2 - x[:, 1])
    assert (field.not_free_m[grid.free] <= edge + 0.1 + 1e-5).all()


def test_the_ground_is_cheap_and_the_wall_is_not(grid):
    costs = grid.costmap(Wheels(max_slope_rad=0.3, max_step_m=0.2))
    inner = costs.height_m[25:60, 10:-10]
    assert abs(np.nanmedian(inner)) < 0.05
    assert np.nanquantile(np.abs(inner), 0.9) < 0.1
    assert np.median(costs.cost[25:60, 10:-10]) < 60
    wall = costs.cost[74:76, 10:-10]  # x from 19.8 to 20.2 m
    assert (wall == 100).mean() > 0.9


def test_map_server_reads_what_it_should(grid, tmp_path):
    flat = grid.flat(0.3, 1.2)
    flat.save(tmp_path / "nav.yaml")
    head, size, depth, pixels = (tmp_path / "nav.pgm").read_bytes().split(b"\n", 3)
    assert (head, size, depth) == (b"P5", b"85 50", b"255")
    image = np.frombuffer(pixels, np.uint8).reshape(50, 85)[::-1].T
    np.testing.assert_array_equal(image, np.choose(flat.state + 1, [205, 254, 0]))
    text = (tmp_path / "nav.yaml").read_text()
    assert "resolution: 0.2\n" in text
    assert "origin: [5.000000000, -5.030000000, 0.0]\n" in text
    assert (flat.state[74:76, 10:-10] == 1).any(axis=0).mean() > 0.9
    assert (flat.state[20:60, 20:-20] == 1).mean() < 0.02


def read_octree(data):
    """States of voxels (x, y, z) of a .bt, from the middle of the tree, as its documentation says."""
    header, _, body = data.partition(b"data\n")
    assert header.startswith(b"# Octomap OcTree binary file\n")
    words = iter(np.frombuffer(body, "<u2").tolist())
    found, nodes = {}, 1

    def inner(corner, edge):
        nonlocal nodes
        word = next(words)
        for child in range(8):
            code = word >> (2 * child) & 3
            half = edge // 2
            first = tuple(c + half * (child >> axis & 1) for axis, c in enumerate(corner))
            nodes += code != 0
            if code == 3:
                inner(first, half)
            elif code:
                for voxel in np.ndindex(half, half, half):
                    found[tuple(a + b for a, b in zip(first, voxel, strict=True))] = code

    inner((-32768,) * 3, 65536)
    assert next(words, None) is None
    assert int(header.split(b"size ")[1].split()[0]) == nodes
    return found


def test_an_octree_holds_the_same_voxels(grid, tmp_path):
    grid.save(tmp_path / "grid.bt")
    found = read_octree((tmp_path / "grid.bt").read_bytes())
    first = np.round(grid.origin / grid.voxel_size).astype(int)
    expected = {
        tuple((first + voxel).tolist()): 1 if grid.state[tuple(voxel)] == 1 else 2
        for voxel in np.argwhere(~grid.unknown)
    }
    assert found == expected


def test_octomap_reads_the_octree(grid, tmp_path):
    octomap = pytest.importorskip("octomap", reason="octomap-python is not installed")
    grid.save(tmp_path / "grid.bt")
    tree = octomap.OcTree(str(tmp_path / "grid.bt").encode())
    for state, occupied in ((1, True), (0, False)):
        for x in grid.centres(grid.state == state)[::97]:
            node = tree.search(x + 1e-6)
            assert tree.isNodeOccupied(node) == occupied


def test_a_ply_holds_what_is_known(grid, tmp_path):
    grid.save(tmp_path / "grid.ply")
    cloud = trimesh.load(tmp_path / "grid.ply")
    assert len(cloud.vertices) == (~grid.unknown).sum()


def test_a_map_without_passages_says_so(scene):
    quick = radarsdf.FitConfig.quick()
    radar_map = radarsdf.fit(scene.points, scene.poses, config=quick, progress=False)
    with pytest.raises(ValueError, match=r"returns\.passages"):
        radar_map.grid(BOX)


def test_tiles_have_the_grid_of_their_cells(tmp_path):
    drive = radarsdf.simulate.wall(seed=5, frames=8)
    scans = radarsdf.io.Scans(drive.points, drive.poses, None, None)
    config = radarsdf.FitConfig.quick(num_threads=1, returns={"passages": True})
    whole = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
    radarsdf.fit_tiles(scans, tmp_path / "city", tile_size=12.8, halo=6.4, config=config, progress=False)
    tiles = radarsdf.load(tmp_path / "city")
    a, b = (radar_map.grid(whole.extent, 0.2) for radar_map in (whole, tiles))
    assert (a.occupied == b.occupied).mean() > 0.99
    cells, of_tiles = (radar_map.cells_round(*(whole.extent + 0.05)) for radar_map in (whole, tiles))
    np.testing.assert_allclose(cells.corner, of_tiles.corner)
    # Which returns are ghosts differs a little from tile to tile.
    seen = cells.passed > 0
    assert seen.sum() > 10_000
    assert (cells.passed == of_tiles.passed)[seen].mean() > 0.95
    assert (cells.returns == of_tiles.returns).mean() > 0.99


def test_the_command_writes_all_files(sharp_map, tmp_path, capsys):
    sharp_map.save(tmp_path / "map.safetensors")
    names = ["g.npz", "g.bt", "g.yaml"]
    words = [
        "grid",
        tmp_path / "map.safetensors",
        *(w for name in names for w in ("-o", tmp_path / name)),
        "--box",
        8,
        -3,
        -1,
        21,
        3,
        3,
    ]
    words += ["--distances", tmp_path / "d.npz", "--costmap", tmp_path / "c.npz", "--heights", 0.3, 1.0]
    assert main([str(word) for word in words]) == 0
    assert "% free" in capsys.readouterr().out
    with np.load(tmp_path / "d.npz") as distances, np.load(tmp_path / "g.npz") as grid:
        assert distances["occupied_m"].shape == grid["state"].shape == (65, 30, 20)
    assert {path.name for path in tmp_path.iterdir()} >= {*names, "g.pgm", "c.npz"}
