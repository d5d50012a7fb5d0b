"""Grids of a plane and a wall: occupied, free and unknown voxels, and files for planners."""

import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import radarsdf
from radarsdf.cli import main
from radarsdf.grids.grid import Grid, Wheels, save_arrays

from scenes.kinds import KINDS

BOX = [[5.0, -5.03, -1.57], [22.0, 4.97, 4.43]]


@pytest.fixture(scope="module")
def grid(sharp_map):
    return radarsdf.grid(sharp_map, BOX, 0.2)


def test_surfaces_are_occupied_air_is_free_and_hidden_space_is_unknown(grid):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(9, 18, 2000), rng.uniform(-4, 4, 2000), np.zeros(2000)])
    assert (grid.at(ground) == 0).mean() < 0.001
    # The ground is the border of two voxels.
    assert np.any([grid.at(ground + [0, 0, z]) == 1 for z in (-0.01, 0.01)], axis=0).mean() > 0.9
    air = rng.uniform([8, -1.5, 0.8], [16, 1.5, 1.3], (2000, 3))
    assert (grid.at(air) == 0).mean() > 0.7
    below, behind = ground - [0, 0, 0.8], np.column_stack([np.full(2000, 21.2), ground[:, 1], air[:, 2]])
    assert (grid.at(np.concatenate([below, behind])) == -1).all()
    assert grid.at([[np.nan, 0, 0], [1e9, 0, 0]]).tolist() == [-1, -1]


def test_a_voxel_touched_by_a_surface_is_not_free():
    """It has no return, since returns were shrunk to the surface, and enough rays cross it above the ground."""
    drive = KINDS["tunnel"](seed=5, frames=12)
    config = radarsdf.FitConfig(num_threads=1)
    radar_map = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
    # The ground is the border of two voxels.
    lower = np.floor(drive.poses[6, :3, 3] / 0.2) * 0.2 - [12, 12, 2]
    grid = radarsdf.grid(radar_map, [lower, lower + [24, 24, 3]], 0.2)
    assert (grid.at(drive.ground_truth) == 0).mean() < 0.0003
    assert grid.free.sum() * 0.2**3 > 190


def test_larger_voxels_are_free_only_if_entirely_free(sharp_map):
    box = [[4.8, -4.8, -1.6], [21.6, 4.8, 4.4]]
    coarse, fine = radarsdf.grid(sharp_map, box, 0.4), radarsdf.grid(sharp_map, box, 0.2)
    x, y, z = coarse.shape
    parts = fine.state.reshape(x, 2, y, 2, z, 2).transpose(0, 2, 4, 1, 3, 5).reshape(x, y, z, 8)
    np.testing.assert_array_equal(coarse.free, (parts == 0).all(axis=-1))
    np.testing.assert_array_equal(coarse.occupied, (parts == 1).any(axis=-1))
    likeliest = np.fmax.reduce(fine.probability.reshape(x, 2, y, 2, z, 2), axis=(1, 3, 5))
    np.testing.assert_array_equal(coarse.probability, likeliest)
    np.testing.assert_array_equal(coarse.distance_m, fine.distance_m[1::2, 1::2, 1::2])
    assert (coarse.voxel_size, coarse.position_error_m) == (0.4, fine.position_error_m)


def ramp(slope, kerb_m=0.0):
    """Ground at -1 m that rises along x by `slope` and by a kerb at x = 1 m; over y > 0.6 m, a beam from 0.4 to 0.6 m."""
    x, y, z = np.meshgrid(*((np.arange(n) + 0.5) * 0.2 for n in (10, 5, 20)), indexing="ij")
    above = z - 2 - (slope * x + kerb_m * (x > 1))
    state = np.where(above > 0, 0, -1)
    state[np.abs(above) <= 0.1] = 1
    state[(y > 0.6) & (np.abs(z - 2.2 - 1.3) < 0.05)] = 1
    none = np.zeros(state.shape, np.float32)
    height_m = -1 + slope * x[:, :, 0] + kerb_m * (x[:, :, 0] > 1)
    grid = Grid(np.array([5.0, 7.0, -3.0]), 0.2, state.astype(np.int8), none, above.astype(np.float32), 0.1)
    return grid, height_m


def test_costs_of_a_ramp_and_a_kerb():
    grid, height_m = ramp(0.2)
    costs = grid.costmap(Wheels(max_slope_rad=0.4, max_step_m=0.2, clearance_m=1.2))
    np.testing.assert_allclose(costs.height_m, height_m, atol=1e-5)
    np.testing.assert_allclose(costs.slope_rad, np.arctan(0.2), atol=1e-5)
    np.testing.assert_allclose(costs.step_m, 0, atol=1e-5)
    assert (costs.cost[:, :3] == np.floor(99 * np.arctan(0.2) / 0.4)).all()
    assert np.isinf(costs.clearance_m[:, :3]).all()
    # The beam begins at 0.4 m.
    np.testing.assert_allclose(costs.clearance_m[:, 3:], 0.4 - height_m[:, 3:], atol=1e-5)
    np.testing.assert_array_equal(costs.cost[:, 3:] == 100, costs.clearance_m[:, 3:] < 1.2)
    assert {True, False} == set((costs.clearance_m[:, 3:] < 1.2).ravel().tolist())
    kerb = ramp(0.0, 0.12)[0].costmap(Wheels(max_slope_rad=1.4, max_step_m=0.1))
    # Next to the kerb, a plane through 0, 0 and 0.12 m, three times each, has a residual of 0.04 m.
    expected = np.zeros(10)
    expected[4:6] = 0.04
    np.testing.assert_allclose(kerb.step_m[:, 2], expected, atol=1e-5)
    np.testing.assert_array_equal(kerb.cost[:, 2], np.where(expected > 0, np.floor(99 * 0.4), 0))
    np.testing.assert_allclose(kerb.slope_rad[4:6, 2], np.arctan(0.06 / 0.2), atol=1e-5)
    assert (ramp(0.0, 0.12)[0].costmap(Wheels(max_step_m=0.039)).cost[4:6] == 100).all()


def test_costs_where_the_ground_is_unknown():
    grid, _ = ramp(0.2)
    grid.distance_m[2, 1], grid.distance_m[5:8, 1] = np.nan, np.nan
    grid.state[5:8, 1] = -1
    costs = grid.costmap(Wheels(max_slope_rad=0.4))
    assert costs.cost[2, 1] == 100  # an obstacle
    assert (costs.cost[5:8, 1] == -1).all()
    assert np.isnan(costs.height_m[5:8, 1]).all()
    np.testing.assert_allclose(costs.slope_rad[3:9, 2], np.arctan(0.2), atol=1e-5)  # from its neighbours
    grid.distance_m[:, :] = np.nan
    grid.distance_m[0, 0], grid.distance_m[0, 1] = ramp(0.2)[0].distance_m[0, :2]
    grid.distance_m[1, 0, 5:7] = grid.distance_m[0, 0, 0]  # no height lies between equal distances
    lone = grid.costmap()
    assert np.isfinite(lone.height_m).sum() == 2
    assert np.isnan(lone.slope_rad).all()  # two columns have no plane


def test_a_column_is_free_if_all_its_voxels_are():
    grid, _ = ramp(0.0)  # ground at -1 m
    assert (grid.flat(0.1, 1.3).state[:, :3] == 0).all()
    assert (grid.flat(0.1, 1.3).state[:, 3:] == 0).all()  # the beam begins at 1.4 m
    assert (grid.flat(0.1, 1.6).state[:, 3:] == 1).all()
    assert (grid.flat(1.7, 1.9).state[:, 3:] == 0).all()
    assert (grid.flat(0.1, 2.0).state[:, :3] == 0).all()  # the box ends 2 m above the ground
    assert (grid.flat(0.1, 2.2).state[:, :3] == -1).all()
    grid.state[3, 1, 12], grid.state[4, 1, 19] = -1, -1
    flat = grid.flat(0.1, 1.9)
    assert flat.state[3, 1] == flat.state[4, 1] == -1
    assert (flat.origin.tolist(), flat.cell_size) == ([5.0, 7.0], 0.2)
    grid.distance_m[5, 2] = np.nan  # the ground of the nearest column is used
    assert grid.flat(0.1, 1.6).state[5, 2] == 0
    for lower_m, upper_m in ((1.0, 1.0), (1.0, 0.5)):
        with pytest.raises(ValueError, match="upper_m must be above lower_m"):
            grid.flat(lower_m, upper_m)
    grid.distance_m[:] = np.nan
    with pytest.raises(ValueError, match="no column of the grid shows ground"):
        grid.flat()


def test_distances_equal_a_brute_force_search():
    state = np.random.default_rng(1).choice([-1, 0, 0, 0, 1], (6, 5, 4))
    field, centres = made(state, [1.0, 2.0, 3.0], 0.5).distances(), np.argwhere(np.ones(state.shape)) * 0.5
    of_states = state.ravel()
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    occupied, free = of_states == 1, of_states == 0
    expected = np.where(occupied, -apart[:, ~occupied].min(axis=1), apart[:, occupied].min(axis=1))
    beyond = np.minimum(centres + 0.5, np.array(state.shape) * 0.5 - centres).min(axis=1)
    expected_not_free = np.where(free, np.minimum(apart[:, ~free].min(axis=1), beyond), 0)
    np.testing.assert_allclose(field.occupied_m.ravel(), expected, rtol=1e-6)
    np.testing.assert_allclose(field.not_free_m.ravel(), expected_not_free, rtol=1e-6)
    assert field.error_m == pytest.approx(np.sqrt(3) / 4)
    nothing = made(np.zeros((2, 2, 2)), [0, 0, 0], 0.5).distances()
    assert np.isinf(nothing.at([[0.5, 0.5, 0.5]])[0]).all()
    assert np.isinf(nothing.occupied_m).all()
    assert (nothing.not_free_m == 0.5).all()


def sloped():
    """Grid of a plane through the box [0, 4] m: free above, occupied next to it, unknown below; and its unit normal."""
    normal = np.array([0.2, -0.3, 0.933])
    normal /= np.linalg.norm(normal)
    centres = (np.argwhere(np.ones((20, 20, 20))) + 0.5) * 0.2
    distance_m = ((centres - 2) @ normal).reshape(20, 20, 20).astype(np.float32)
    state = np.where(distance_m > 0, 0, -1)
    state[np.abs(distance_m) <= 0.15] = 1
    distance_m[np.abs(distance_m) > 0.3] = np.nan  # not observed
    return Grid(np.zeros(3), 0.2, state.astype(np.int8), distance_m, distance_m, 0.0), normal


def test_interpolated_distances_and_gradients_of_a_plane():
    grid, normal = sloped()
    field = grid.distances()
    x = np.random.default_rng(0).uniform(0, 4, (20_000, 3))
    distance_m, gradient = field.at(x)
    np.testing.assert_array_equal(np.isnan(distance_m), grid.at(x) == -1)
    np.testing.assert_array_equal(np.isnan(gradient).all(axis=1), grid.at(x) == -1)
    inner = (np.abs(x - 2) < 1.2).all(axis=1) & (grid.at(x) >= 0)
    expected = (x[inner] - 2) @ normal
    assert np.abs(distance_m[inner] - expected).max() < 0.06
    assert np.median(np.abs(distance_m[inner] - expected)) < 0.025
    assert (gradient[inner] @ normal > 0.8).all()
    from scipy.interpolate import RegularGridInterpolator  # noqa: PLC0415

    peer = RegularGridInterpolator([(np.arange(20) + 0.5) * 0.2] * 3, field.surface_m)
    x = x[((x > 0.1) & (x < 3.9)).all(axis=1) & (grid.at(x) >= 0)]
    np.testing.assert_allclose(field.at(x)[0], peer(x), atol=1e-5)
    cells = np.floor(x / 0.2 - 0.5)
    x = x[(np.floor((x + 1e-4) / 0.2 - 0.5) == cells).all(axis=1)]
    slopes = [(peer(x + step) - peer(x)) / 1e-4 for step in 1e-4 * np.eye(3)]
    np.testing.assert_allclose(field.at(x)[1].T, slopes, atol=0.01)
    outside = field.at([[np.nan, 1, 1], [1, 1, 4.01], [1e30, -1e30, np.inf]])
    assert np.isnan(outside[0]).all()
    assert np.isnan(outside[1]).all()


def test_obstacles_count_as_surface_where_the_map_has_none():
    grid, _ = sloped()
    boxes = [[[1.03, 1.1, 3.05], [1.62, 2.0, 9.0]], [[9, 9, 9], [10, 10, 10]]]  # reaches out, is outside
    field = grid.distances(boxes)
    x = np.array([[0.65, 1.5, 3.6], [1.3, 1.5, 3.6], [2.1, 1.5, 3.6]])
    distance_m, gradient = field.at(x)
    np.testing.assert_allclose(distance_m, [1.03 - 0.65, -0.27, 2.1 - 1.62], atol=1e-5)
    np.testing.assert_allclose(gradient[[0, 2]], [[-1, 0, 0], [1, 0, 0]], atol=1e-5)
    assert (field.occupied_m < 0).sum() > (grid.distances().occupied_m < 0).sum()
    below = [[2.05, 2.15, 0.55]]  # a point in unknown space
    assert np.isnan(grid.distances().at(below)[0])
    assert grid.distances(below).at(below)[0] < 0.5 * np.sqrt(3) * 0.2  # a corner of its voxel
    for wrong in (np.zeros((2, 2)), [[[1, 1, 1], [0, 2, 2]]], [[np.nan, 0, 0]]):
        with pytest.raises(ValueError, match="obstacles must be"):
            grid.distances(wrong)


def in_openvdb(path, shape):
    """Values (X, Y, Z), NaN where inactive, background, class and position of voxel 0, as OpenVDB of the system reads them."""
    script = (
        "import pyopenvdb as v, json, sys; g = v.read(sys.argv[1], 'distance'); "
        "print(json.dumps([[[*i['min'], i['value']] for i in g.citerOnValues()], "
        "g.background, g.gridClass, g.transform.indexToWorld((0, 0, 0))]))"
    )
    python = shutil.which("python3", path="/usr/bin")
    done = python and subprocess.run([python, "-c", script, str(path)], capture_output=True, check=False)
    if not python or b"No module named" in done.stderr:
        pytest.skip("no OpenVDB for Python: Debian's python3-openvdb")
    active, *rest = json.loads(done.stdout)
    values = np.full(shape, np.nan, np.float32)
    for *voxel, value in active:
        values[tuple(voxel)] = value
    return values, *rest


def in_tinyvdb(path, shape):
    file = pytest.importorskip("tinyvdb").open(str(path))
    file.read_grids()
    grid = file.grid(0)
    active, values = grid.to_sparse(), np.full(shape, np.nan, np.float32)
    voxels = np.frombuffer(active["coords"], np.int32).reshape(-1, 3)
    values[tuple(voxels.T)] = np.frombuffer(active["values"], np.float32)
    return values, grid.float_background(), grid.metadata["class"], grid.transform["translation"]


@pytest.mark.parametrize("reader", [in_tinyvdb, in_openvdb])
def test_vdb_readers_get_the_distances_of_known_voxels(reader, tmp_path):
    field = sloped()[0].distances()
    wide = np.random.default_rng(0).random((140, 9, 37), np.float32)  # over two nodes of 128 voxels
    spread = replace(field, surface_m=wide, known=wide > 0.6)
    # tinyvdb 0.9 skips the voxels of a node beyond 64.
    for one in [field] if reader is in_tinyvdb else [field, spread]:
        save_arrays(tmp_path / "distances.vdb", sloped()[0], one)
        values, background, kind, first = reader(tmp_path / "distances.vdb", one.known.shape)
        np.testing.assert_array_equal(values, np.where(one.known, one.surface_m, np.nan))
        assert (background, kind) == (one.surface_m[one.known].max(), "level set")
        np.testing.assert_allclose(first, [0.1, 0.1, 0.1])


def test_positions_are_located_in_their_voxel():
    grid = made(np.arange(24).reshape(2, 3, 4) % 3 - 1, [1.0, 2.0, 3.0], 0.5)
    centres = grid.centres()
    np.testing.assert_array_equal(grid.at(centres), grid.state.ravel())
    np.testing.assert_array_equal(grid.at(centres - 0.2499), grid.state.ravel())
    assert centres[0].tolist() == [1.25, 2.25, 3.25]
    assert centres[-1].tolist() == [1.75, 3.25, 4.75]
    np.testing.assert_array_equal(grid.centres(grid.occupied), centres[grid.state.ravel() == 1])
    upper = np.array([2.0, 3.5, 5.0]) - 1e-9
    assert grid.at([upper]).tolist() == [grid.state[-1, -1, -1]]
    assert grid.at([[1.0, 2.0, 3.0]] + 2e-9 * np.eye(3)).tolist() == [grid.state[0, 0, 0]] * 3
    assert grid.at(upper + 2e-9 * np.eye(3)).tolist() == [-1] * 3
    assert grid.at(np.array([1.0, 2.0, 3.0]) - 2e-9 * np.eye(3)).tolist() == [-1] * 3
    for wrong in (upper, [upper[:2]], [[upper]]):
        with pytest.raises(ValueError, match="positions must have shape"):
            grid.at(wrong)


def in_map_server(path):
    """States (X, Y), resolution and origin of a map as ROS's map_server reads it in its mode `trinary`."""
    yaml, image = pytest.importorskip("yaml"), pytest.importorskip("PIL.Image")
    read = yaml.safe_load(path.read_text("utf-8"))
    with image.open(path.parent / read["image"]) as opened:
        pixels = np.asarray(opened, np.float64)
    assert read["mode"] == "trinary"
    occupancy = pixels / 255 if read["negate"] else (255 - pixels) / 255
    state = np.full(pixels.shape, -1)
    state[occupancy > read["occupied_thresh"]] = 1
    state[occupancy < read["free_thresh"]] = 0
    return state[::-1].T, read["resolution"], read["origin"]  # its first row has the largest y


def test_map_server_reads_the_written_states(grid, tmp_path):
    flat = grid.flat(0.3, 1.2)
    flat.save(tmp_path / "it's a map.yaml")
    state, resolution, origin = in_map_server(tmp_path / "it's a map.yaml")
    np.testing.assert_array_equal(state, flat.state)
    assert set(np.unique(state)) == {-1, 0, 1}
    assert resolution == 0.2
    np.testing.assert_allclose(origin, [5, -5.2, 0], atol=1e-9)
    assert (flat.state[74:76, 10:-10] == 1).any(axis=0).mean() > 0.9
    assert (flat.state[20:60, 20:-20] == 1).mean() < 0.02


def made(state, origin, voxel_size):
    """Grid with the given states."""
    numbers = np.full(state.shape, 0.5, np.float32)
    return Grid(np.array(origin), voxel_size, state.astype(np.int8), numbers, numbers, 0.0)


def in_octomap(grid, path):
    """States (X, Y, Z) at the centres of a grid's voxels, of the file as OctoMap reads it; and its edges of leaves, m."""
    octomap = pytest.importorskip("octomap", reason="octomap-python has no wheel for this platform")
    grid.save(path)
    tree = octomap.OcTree(str(path).encode())
    assert tree.getResolution() == pytest.approx(grid.voxel_size)
    corners = np.array([grid.origin, grid.origin + np.array(grid.shape) * grid.voxel_size])
    edges_m = [leaf.getSize() for leaf in tree.begin_leafs()]
    if edges_m:
        assert (tree.getMetricMin() >= corners[0] - 1e-6).all()
        assert (tree.getMetricMax() <= corners[1] + 1e-6).all()
    return tree.getLabels(grid.centres()).reshape(grid.shape), np.array(edges_m)


def test_octomap_reads_the_state_of_each_voxel(grid, tmp_path):
    found, _ = in_octomap(grid, tmp_path / "map.bt")
    np.testing.assert_array_equal(found, grid.state)
    state = np.random.default_rng(0).integers(-1, 2, (24, 9, 13))
    state[:8, :8, :8], state[8:16, :8, :8] = 1, 0  # become leaves eight voxels wide
    found, edges_m = in_octomap(made(state, [-1.6, 0.0, -3.2], 0.2), tmp_path / "random.bt")
    np.testing.assert_array_equal(found, state)
    assert (edges_m > 1.5).sum() == 2
    for number in (1, 0, -1):
        state = np.full((2, 2, 2), number)
        np.testing.assert_array_equal(in_octomap(made(state, np.zeros(3), 0.1), tmp_path / "a.bt")[0], state)


def test_grids_are_aligned_to_octomap_and_other_origins_are_rejected(sharp_map, tmp_path):
    for size in (0.13, 0.2, 0.5):
        box = np.array([[9.07, -2.93, -0.71], [14.0, 2.0, 1.2]])
        grid = radarsdf.grid(sharp_map, box, size)
        np.testing.assert_allclose(grid.origin / size, np.round(grid.origin / size), atol=1e-9)
        upper = grid.origin + np.array(grid.shape) * size
        assert ((grid.origin <= box[0]) & (box[0] < grid.origin + size)).all()
        assert ((upper >= box[1] - 1e-9) & (box[1] > upper - size)).all()
        np.testing.assert_array_equal(in_octomap(grid, tmp_path / "grid.bt")[0], grid.state)
    assert radarsdf.grid(sharp_map, [[9.05, 0.05, 0.05], [9.15, 0.1, 0.15]], 0.2).shape == (1, 1, 1)
    assert radarsdf.grid(sharp_map, [[9.0, 0.2, 0.0], [9.2, 0.6, 0.2]], 0.2).shape == (1, 2, 1)
    with pytest.raises(ValueError, match=r"0\.07.*multiple.*0\.2 m.*0\. "):
        made(np.ones((2, 2, 2)), [0.07, 0.2, 0.4], 0.2).save(tmp_path / "off.bt")
    with pytest.raises(ValueError, match="32768"):
        made(np.ones((2, 2, 2)), [7000.0, 0, 0], 0.2).save(tmp_path / "far.bt")
    ends = np.ones((2, 1, 1))  # the tree spans 2 ** 16 voxels
    for first in (-32768, 32766):
        assert (in_octomap(made(ends, [first * 0.5, 0, 0], 0.5), tmp_path / "end.bt")[0] == 1).all()
    for first in (-32769, 32767):
        with pytest.raises(ValueError, match="32768"):
            made(ends, [first * 0.5, 0, 0], 0.5).save(tmp_path / "far.bt")


def test_a_map_without_free_space_is_rejected(scene):
    quick = radarsdf.FitConfig.quick()
    radar_map = radarsdf.fit(scene.points, scene.poses, config=quick, progress=False)
    with pytest.raises(ValueError, match=r"returns\.free_space"):
        radarsdf.grid(radar_map, BOX)


def test_grids_of_tiles_equal_the_grid_of_one_map(tmp_path):
    drive = radarsdf.simulate.wall(seed=5, frames=8)
    scans = radarsdf.io.Scans(drive.points, drive.poses, None, None)
    config = radarsdf.FitConfig.quick(num_threads=1, returns={"free_space": True})
    whole = radarsdf.fit(drive.points, drive.poses, config=config, progress=False)
    radarsdf.fit_tiles(scans, tmp_path / "city", tile_size=12.8, halo=6.4, config=config, progress=False)
    tiles = radarsdf.load(tmp_path / "city")
    a, b = (radarsdf.grid(radar_map, whole.extent, 0.2) for radar_map in (whole, tiles))
    assert (a.occupied == b.occupied).mean() > 0.99
    cells, of_tiles = (radar_map.cells_near(*(whole.extent + 0.05)) for radar_map in (whole, tiles))
    np.testing.assert_allclose(cells.corner, of_tiles.corner)
    # Ghosts differ slightly between tiles.
    seen = cells.passed > 0
    assert seen.sum() > 10_000
    assert (cells.passed == of_tiles.passed)[seen].mean() > 0.95
    assert (cells.returns == of_tiles.returns).mean() > 0.99


def test_the_command_writes_all_files(sharp_map, tmp_path, capsys):
    sharp_map.save(tmp_path / "map.safetensors")
    names = ["g.npz", "g.bt", "g.yaml"]
    words = ["grid", tmp_path / "map.safetensors", *(w for name in names for w in ("-o", tmp_path / name))]
    words += ["--box", 8, -3, -1, 21, 3, 3]
    words += ["--distances", tmp_path / "d.npz", "--costmap", tmp_path / "c.npz", "--heights", 0.3, 1.0]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr().out
    with np.load(tmp_path / "d.npz") as distances, np.load(tmp_path / "g.npz") as grid:
        assert f"{100 * np.mean(grid['state'] == 1):.1f} % occupied" in said
        assert distances["occupied_m"].shape == grid["state"].shape == (65, 30, 20)
    assert {path.name for path in tmp_path.iterdir()} >= {*names, "g.pgm", "c.npz"}
    flat = radarsdf.grid(sharp_map, [[8, -3, -1], [21, 3, 3]], 0.2).flat(0.3, 1.0)
    np.testing.assert_array_equal(in_map_server(tmp_path / "g.yaml")[0], flat.state)
