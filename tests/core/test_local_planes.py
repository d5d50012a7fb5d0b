"""Planes that scans are tracked by while others come and go, and planes common to scans, against dense least squares."""

import numpy as np
import pytest
from radarsdf._core import CommonPlanes, LocalPlanes
from radarsdf.poses.rigid import moved
from scipy import sparse
from scipy.linalg import block_diag

VARIANCES = [0.02**2, 0.002**2, 0.002**2]


def room(seed, count=12000):
    """Returns of a room of 18 x 14 x 10 m from its middle."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [9, 7, 5]
    wall = rng.integers(0, 3, count)
    rows = np.arange(count)
    points[rows, wall] = np.sign(points[rows, wall]) * np.array([9, 7, 5])[wall]
    return points + rng.normal(0, 0.02, (count, 3))


def planes_of(*scans):
    planes = LocalPlanes(0.8)
    for scan in scans:
        planes.add(scan)
    return planes


def pose(*increment):
    return moved(np.eye(4)[None], np.array([increment], float))[0]


def test_removal_restores_the_previous_state():
    rng = np.random.default_rng(0)
    scans = [room(seed) + rng.normal(0, 20, 3) for seed in range(6)]
    kept = planes_of(scans[1], scans[4])
    changed = planes_of(*scans)
    for i in (5, 0, 3, 2):
        changed.add(scans[i], -1)
    assert changed.num_cells == kept.num_cells
    scan = scans[1] - scans[1].mean(axis=0)
    at = np.eye(4)
    at[:3, 3] = scans[1].mean(axis=0)
    for one, other in zip(
        changed.agreement(scan, at, VARIANCES), kept.agreement(scan, at, VARIANCES), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_removing_absent_points_is_rejected():
    planes = planes_of(room(0))
    cells = planes.num_cells
    with pytest.raises(ValueError, match="never added"):
        planes.add(np.concatenate([room(0), [[50.0, 0, 0]]]), -1)
    assert planes.num_cells == cells
    with pytest.raises(ValueError, match="too far"):
        planes.add(np.array([[1e9, 0, 0]]))
    with pytest.raises(ValueError, match="sign"):
        planes.add(room(0), 2)


def test_steps_by_gradient_and_hessian_lead_to_the_pose():
    planes, scan = planes_of(room(0), room(1)), room(2)
    true = pose(0.05, -0.04, 0.03, 0.01, -0.008, 0.012)
    seen = np.ascontiguousarray((scan - true[:3, 3]) @ true[:3, :3])
    found = np.eye(4)
    for _ in range(8):
        hessian, gradient, doubt, weight = planes.agreement(seen, found, VARIANCES)
        found = moved(found[None], -np.linalg.solve(hessian, gradient)[None])[0]
    np.testing.assert_allclose(found, true, atol=4e-3)
    assert weight > 0.6 * len(scan)
    assert np.linalg.eigvalsh(hessian - doubt).min() > 0


def test_scores_do_not_depend_on_threads():
    poses = np.stack([pose(x, 0, 0, 0, 0, 0.1 * x) for x in np.linspace(-1, 1, 20)])
    scores = [planes_of(room(0)).scores(room(1), poses, VARIANCES, threads) for threads in (1, 2, 5)]
    assert scores[0].mean() > 0.1
    for found in scores[1:]:
        np.testing.assert_array_equal(found, scores[0])


def test_along_a_wall_the_position_is_unobservable():
    rng = np.random.default_rng(0)

    def wall():
        return np.column_stack([rng.normal(5, 0.1, 2000), rng.uniform(-5, 5, 2000), rng.uniform(-1, 1, 2000)])

    planes = planes_of(wall(), wall())
    hessian, _, doubt, _ = planes.agreement(wall(), np.eye(4), VARIANCES)
    across, along = doubt[0, 0] / hessian[0, 0], doubt[1, 1] / hessian[1, 1]
    assert across < 0.05
    assert 0.4 < along < 2.5


SCANS, PLANES, EXTENT_M = 7, 12, 0.8
SPREAD = np.outer(np.linspace(1, 2, SCANS), [0.05**2, 0.01**2, 0.02**2])  # of each scan


def returns(seed=0, count=600):
    """Returns near random planes, each observed by few scans."""
    rng = np.random.default_rng(seed)
    scans = np.sort(rng.integers(0, SCANS, count)).astype(np.int32)
    planes = ((scans + rng.integers(0, 5, count)) % PLANES).astype(np.int32)
    planes[rng.random(count) < 0.1] = -1
    planes[(planes == 0) & (scans > 0)] = -1  # observed only by the first scan
    normals = rng.normal(size=(PLANES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centres, positions = rng.normal(0, 5, (PLANES, 3)), rng.normal(0, 1, (SCANS, 3))
    points = centres[planes] + rng.normal(0, 0.2, (count, 3))
    rays = points - positions[scans]
    ranges_m = np.linalg.norm(rays, axis=1)
    up = np.tile([0.0, 0, 1], (SCANS, 1))
    return (
        points.astype(np.float32), (rays / ranges_m[:, None]).astype(np.float32), ranges_m.astype(np.float32),
        scans, planes, positions, up, centres, normals,
    )  # fmt: skip


def dense(given, scale):
    """Hessian (F, 6, F, 6) and gradient (F, 6) of the poses: unknowns of planes eliminated by NumPy."""
    points, directions, ranges_m, scans, planes, positions, up, centres, normals = given
    size = 6 * SCANS + 3 * PLANES
    H, g = np.zeros((size, size)), np.zeros(size)
    for p in range(PLANES):
        rows = np.flatnonzero(planes == p)
        if len(set(scans[rows])) < 2:
            continue
        n = normals[p]
        across = np.linalg.svd(n[None])[2][1:]  # any basis, since the tilts are eliminated
        for i in rows:
            d = directions[i].astype(float)
            azimuth = np.cross(up[scans[i]], d)
            azimuth /= np.linalg.norm(azimuth)
            axes = np.stack([d, azimuth, np.cross(d, azimuth)]) @ n
            variance = scale * (axes**2 @ (SPREAD[scans[i]] * [1, ranges_m[i] ** 2, ranges_m[i] ** 2]))
            off = points[i] - centres[p]
            r = off @ n
            w = (1 + r**2 / (4 * variance)) ** -2 / variance
            j = np.zeros(size)
            j[6 * scans[i] : 6 * scans[i] + 6] = [*n, *np.cross(points[i] - positions[scans[i]], n)]
            j[6 * SCANS + 3 * p : 6 * SCANS + 3 * p + 3] = [-1, *(-(across @ off) / EXTENT_M)]
            H += w * np.outer(j, j)
            g += w * r * j
    a, b, c = H[: 6 * SCANS, : 6 * SCANS], H[: 6 * SCANS, 6 * SCANS :], H[6 * SCANS :, 6 * SCANS :]
    taken = b @ np.linalg.pinv(c)
    return a - taken @ b.T, g[: 6 * SCANS] - taken @ g[6 * SCANS :]


def prior(rng, width=3):
    """Band of a prior, its gradient, and the band as one matrix."""
    band = rng.normal(0, 1, (SCANS, width, 6, 6))
    band[:, -1] = 30 * np.eye(6)
    whole = np.zeros((SCANS, 6, SCANS, 6))
    for s in range(SCANS):
        for other in range(max(0, s - width + 1), s + 1):
            block = band[s, other - s + width - 1]
            whole[s, :, other], whole[other, :, s] = block, block.T
    return band, rng.normal(0, 1, (SCANS, 6)), whole.reshape(6 * SCANS, 6 * SCANS)


@pytest.mark.parametrize("together", [1, 2, 4, SCANS])
def test_increments_equal_the_dense_solution(together):
    given = returns()
    found = CommonPlanes(*given, EXTENT_M, SPREAD, together, 2)
    scans, planes = given[3:5]
    seen = [p for p in range(PLANES) if len(set(scans[planes == p])) > 1]
    assert 5 < len(seen) < PLANES
    H, g = dense(given, found.scale)
    diagonal, gradient, coupling, of_cluster, first = found.equations
    C = sparse.bsr_matrix((coupling.reshape(-1, 3, 6), of_cluster, first), (3 * PLANES, 6 * SCANS)).toarray()
    np.testing.assert_allclose(
        block_diag(*diagonal.reshape(-1, 6, 6)) - C.T @ C, H, atol=1e-5 * np.abs(H).max()
    )
    np.testing.assert_allclose(gradient, g, atol=1e-5 * np.abs(g).max())
    band, gradient, whole = prior(np.random.default_rng(1))
    x, inverse, inverse_below, decrement = found.solve(band, gradient, 1e-10, 200, True, 2)
    expected = -np.linalg.solve(H + whole, g + gradient.reshape(-1))
    np.testing.assert_allclose(x.reshape(-1), expected, atol=2e-5 * np.abs(expected).max())
    assert decrement == pytest.approx(-(g + gradient.reshape(-1)) @ expected, rel=1e-4)
    C = np.linalg.inv(H + whole).reshape(SCANS, 6, SCANS, 6)
    for s in range(SCANS):
        if together == SCANS:
            np.testing.assert_allclose(inverse[s], C[s, :, s], atol=2e-5 * np.abs(C).max())
            if s:
                np.testing.assert_allclose(inverse_below[s - 1], C[s, :, s - 1], atol=2e-5 * np.abs(C).max())
        else:  # the band has less information
            assert np.linalg.eigvalsh(inverse[s] - C[s, :, s]).min() > -1e-6 * np.abs(C).max()


def test_the_inverse_is_accurate_along_a_chain_of_unequal_steps():
    """Regression: its errors grew tenfold from scan to scan."""
    count, spread = 60, np.random.default_rng(1).normal(size=(6, 6))
    shares = np.tile([0.1, 10.0], count)[
        : count - 2, None
    ]  # of the duration of a step to that of the one before
    eye, spread = np.eye(count), spread @ spread.T + np.eye(6)
    rows = eye[2:] - (1 + shares) * eye[1:-1] + shares * eye[:-2]
    chain = 1e4 * rows.T @ rows + eye
    band = np.stack([np.pad(np.diag(chain, -lag), (lag, 0)) for lag in (2, 1, 0)], 1)
    given = [part[:0] for part in returns()]
    given[5:7] = np.zeros((2, count, 3))
    planes = CommonPlanes(*given, EXTENT_M, np.ones((count, 3)), 3)
    inverse = planes.solve(band[:, :, None, None] * spread, np.zeros((count, 6)), 1e-6, 50, True)[1]
    expected = np.linalg.inv(chain).diagonal()[:, None, None] * np.linalg.inv(spread)
    np.testing.assert_allclose(inverse, expected, atol=1e-6 * expected.max())


def test_the_scale_is_the_median_squared_residual():
    rng = np.random.default_rng(2)
    given = list(returns(count=4000))
    points, _, ranges_m, _, planes, _, _, centres, normals = given
    scales = []
    for sigma_m in (0.01, 0.05, 0.2):
        off = rng.normal(0, sigma_m, len(points))[:, None] * normals[planes]
        given[0] = (centres[planes] + off).astype(np.float32)
        isotropic = np.tile([0.05, *[0.05 / ranges_m.max()] * 2], (SCANS, 1)) ** 2
        given[2] = np.full(len(points), ranges_m.max(), np.float32)
        scales.append(CommonPlanes(*given, EXTENT_M, isotropic, SCANS).scale)
    np.testing.assert_allclose(scales, [1, 1, 16], rtol=0.1)


def test_results_do_not_depend_on_threads():
    given = returns(3, 40_000)
    band, gradient, _ = prior(np.random.default_rng(1))
    answers = [
        CommonPlanes(*given, EXTENT_M, SPREAD, 3, threads).solve(band, gradient, 1e-6, 50, True, threads)
        for threads in (1, 2, 5)
    ]
    for answer in answers[1:]:
        for found, expected in zip(answer[:3], answers[0][:3], strict=True):
            np.testing.assert_array_equal(found, expected)
