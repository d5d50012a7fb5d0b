"""Modules below all subpackages: the limits of checks, the lattice of the world, and the memory that is left."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, checks
from radarsdf.lattice import WorldLattice
from radarsdf.memory import available_bytes
from radarsdf.rig import Imu
from scipy.spatial.transform import Rotation

FAR = np.nextafter(1e12, np.inf)


def refuses(function, *arguments, kind=ValueError):
    with pytest.raises(kind, match=r"name|box"):
        function(*arguments)
    return True


def test_positions_and_boxes():
    np.testing.assert_array_equal(checks.positions([[1e12, -1e12, 0]], "name"), [[1e12, -1e12, 0]])
    for wrong in ([[FAR, 0, 0]], [[0, -FAR, 0]], [[0, np.nan, 0]], [[0, 0]], [0, 0, 0]):
        assert refuses(checks.positions, wrong, "name")
    np.testing.assert_array_equal(checks.check_box([[0, 0, 0], [1, 1, 1]]), [[0, 0, 0], [1, 1, 1]])
    assert all(refuses(checks.check_box, wrong) for wrong in ([[0, 0, 0], [1, 1, 0]], [[0, 0], [1, 1]]))


def test_rigid_transforms():
    good, scaled, sheared, mirrored, far, row = (np.eye(4) for _ in range(6))
    good[:3, :3] = Rotation.from_euler("ZYX", [2.0, 0.3, -1.0]).as_matrix() * (1 + 4.9e-4)
    good[:3, 3] = 1e12, -1e12, 0
    scaled[:3, :3] *= 1 + 5.1e-4
    sheared[0, 1] = 1.1e-3
    mirrored[1, 1] = -1
    far[0, 3] = FAR
    row[3, 3] = 1 + 1e-9
    found = checks.are_rigid(np.stack([good, scaled, sheared, mirrored, far, row, np.full((4, 4), np.nan)]))
    assert found.tolist() == [True] + [False] * 6


def test_a_minority_of_invalid_poses_is_interpolated():
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, :3, 3] = np.arange(7)[:, None] * [1.0, 2, 3]
    poses[:, :3, :3] = Rotation.from_euler("z", 0.2 * np.arange(7)[:, None]).as_matrix()
    broken = poses.copy()
    broken[[0, 3, 4]] = np.nan
    found, rigid = checks.usable_poses(broken)
    assert np.flatnonzero(~rigid).tolist() == [0, 3, 4]
    np.testing.assert_allclose(found[1:], poses[1:], atol=1e-12)
    np.testing.assert_allclose(found[0], poses[1], atol=1e-12)  # nothing is known before
    broken[6] = np.nan
    for wrong in (broken, broken[:2]):  # one of two is not a minority
        with pytest.raises(ValueError, match="pose 0 is not a rigid transform"):
            checks.usable_poses(wrong)


def test_measurements_of_an_imu():
    times_s, rates = np.array([0.0, 1.0, 1.0]), np.zeros((3, 3))
    assert len(Imu(times_s, rates, rates)) == 3  # equal times pass
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 0.4).as_matrix()
    turn[:3, 3] = 1, 2, 3
    np.testing.assert_array_equal(Imu(times_s, rates, None, turn).R_sensor_imu, turn[:3, :3])
    for wrong in (
        (times_s[::-1], rates), (times_s[:2], rates), (times_s, rates[:, :2]), (times_s, rates, rates * np.nan),
        (times_s[:0], rates[:0]), (times_s, rates, None, 2 * np.eye(3)), (times_s, rates, None, np.eye(5)),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"IMU|R_sensor_imu"):
            Imu(*wrong)


LATTICE = WorldLattice(0.2, 32)


def test_positions_and_cells_are_inverse():
    cells = np.random.default_rng(0).integers(-(10**7), 10**7, (100, 3))
    np.testing.assert_allclose(LATTICE.cells(LATTICE.position(cells)), cells, rtol=0, atol=1e-6)
    np.testing.assert_allclose(LATTICE.position(cells + 5) - LATTICE.position(cells), 1.0, atol=1e-8)


def test_the_nearest_block_is_within_half_a_block():
    places = np.random.default_rng(1).uniform(-1e6, 1e6, (1000, 3))
    blocks = LATTICE.nearest_block(places)
    assert (blocks % 32 == 0).all()
    assert np.abs(LATTICE.position(blocks) - places).max() <= 3.2 + 1e-9


@pytest.mark.parametrize("level", range(6))
@pytest.mark.parametrize("coordinate_m", [0.0, 0.2, 1.0, -2.0, 5.0, 6.4, 12.8, 100.0])
def test_no_plane_at_a_round_coordinate_is_a_face_of_cells(level, coordinate_m):
    place = LATTICE.cells(coordinate_m) / 2**level
    assert abs(place - np.round(place)) * 2**level > 0.3  # leaf cells


def test_maps_of_overlapping_scans_share_their_cells():
    scans = radarsdf.simulate.wall(frames=8)
    config = FitConfig.quick()
    corners = [
        config.lattice.cells(radarsdf.fit(scans.points[part], scans.poses[part], config=config).origin)
        for part in (slice(0, 4), slice(4, 8))
    ]
    for corner in corners:
        np.testing.assert_allclose(corner, 32 * np.round(corner / 32), rtol=0, atol=1e-9)
    assert not np.allclose(corners[0], corners[1])


def tree(root, groups, **files):
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable: 5000 kB\n")
    (root / "proc/self/cgroup").write_text(groups)
    for name, content in files.items():
        path = root / "sys/fs/cgroup" / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(path.name.replace("memory_", "memory.")).write_text(content)


def test_of_the_system(tmp_path):
    tree(tmp_path, "0::/\n", memory_max="max\n", memory_current="7")
    assert available_bytes(tmp_path) == 5000 * 1024


def test_of_a_control_group(tmp_path):
    files = {"a__b__memory_max": "3000000", "a__b__memory_current": "1000000"}
    tree(tmp_path, "0::/a/b\n", **files, a__b__memory_stat="anon 5\ninactive_file 200000\n")
    assert available_bytes(tmp_path) == 2_200_000


def test_a_mesh_beyond_the_budget_is_refused(scene):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(max_memory_bytes=10**9))
    radar_map.mesh(0.1)
    with pytest.raises(MemoryError, match=r"voxels of 0\.005 m"):
        radar_map.mesh(0.005)
