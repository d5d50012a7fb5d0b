"""Intensities in closed form: by range, elevation, incidence and kind of surface, and means of what that leaves."""

import numpy as np
import pytest
import radarsdf
from radarsdf.evaluation import KNNIntensity, holdout
from radarsdf.fitting import fit as steps
from radarsdf.returns import intensities as plausible
from radarsdf.returns import reflectance, sensor
from radarsdf.returns.intensities import Intensities, Plausible
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.reflectance import LEVEL, NO_SURFACE, STEEP, Reflectance, kinds_of

LEAF_M = 0.2


@pytest.fixture(scope="module")
def rays():
    scans = radarsdf.simulate.wall(frames=12, seed=2)
    return prepare(scans.points, scans.poses, scans.intensities, min_range_m=2.5)


def split(rays, every=4):
    """The rays of the training scans, and of the held-out ones."""
    test = np.isin(rays.scans, holdout(rays.scans, every)[1])
    return rays.select(~test), rays.select(test)


def unit(rays):
    values = rays.intensities
    return ((values - values.min()) / (values.max() - values.min())).astype(np.float32)


def learnt(rays, values, num_threads=1):
    surfels = Surfels.of(rays, LEAF_M, num_threads)
    return Reflectance.of(rays, values, surfels, LEAF_M, num_threads=num_threads)


def at(found, rays):
    return found.at(rays.points, rays.directions, rays.ranges_m, 1).clip(0, 1)


def test_it_is_better_than_nearest_neighbours(rays):
    train, test = split(rays)
    low, high = train.intensities.min(), train.intensities.max()
    own = low + (high - low) * at(learnt(train, unit(train)), test)
    knn = KNNIntensity.chosen(*train.in_world(), train.intensities, train.scans)
    error = np.abs(own - test.intensities).mean()
    assert error < 0.99 * np.abs(knn.predict(*test.in_world()) - test.intensities).mean()


def test_with_a_network_the_prediction_is_the_mean_of_two(rays):
    """That of the network, and half of it plus the closed form of the residual."""
    answers = np.linspace(0.2, 0.6, len(rays), dtype=np.float32)
    surfels = Surfels.of(rays, LEAF_M, 1)
    found = Reflectance.of(rays, unit(rays), surfels, LEAF_M, lambda *_: answers)
    closed = Reflectance.of(rays, unit(rays) - answers / 2, surfels, LEAF_M)
    whole, leaves = (r.at(rays.points, rays.directions, rays.ranges_m, 1) for r in (found, closed))
    assert closed.network_share == 0
    expected = (answers + (answers / 2 + leaves)) / 2
    np.testing.assert_allclose(found.network_share * answers + whole, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("most", [1000, 10**9], ids=["groups", "returns"])
def test_any_number_of_threads_has_the_same_bits(rays, monkeypatch, most):
    monkeypatch.setattr(reflectance, "_MOST_RETURNS", most)
    values = unit(rays)
    first, other = learnt(rays, values, 1), learnt(rays, values, 3)
    assert len(first.means) > 1000
    for name in ("coefficients", "table", "plane_keys", "normals", "mean_keys", "means"):
        np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


def test_predictions_are_finite_everywhere(rays):
    found = learnt(rays, unit(rays))
    points = np.array([[0, 0, 0], [1e7, -1e7, 1e7], [1e30, 0, 0]], np.float32)
    directions = np.tile(np.float32([1, 0, 0]), (3, 1))
    answers = found.at(points, directions, np.array([0, 1e7, 1e30], np.float32), 1)
    assert np.isfinite(answers).all()


COUNT = 6000


def views(seed=0, kinds=(LEVEL, STEEP), count=COUNT):
    """Directions, ranges, incidences and kinds of surfaces of random returns, as arguments of :func:`response`."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = rng.uniform(-0.4, 0.4, count), rng.uniform(-1, 1, count)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    kind = rng.choice(np.array(kinds, np.int8), count)
    incidence = np.where(kind == NO_SURFACE, np.nan, rng.uniform(0, 1.4, count))
    return reflectance.Views(
        directions.astype(np.float32),
        rng.uniform(2, 40, count).astype(np.float32),
        incidence.astype(np.float32),
        kind,
    )


def error(values, seen, asked=None, truth=None):
    """Mean absolute error of predictions from `values` of returns."""
    asked, truth = (seen, values) if asked is None else (asked, truth)
    found = reflectance.response(*reflectance.fit_response(values, seen), asked)
    return float(np.abs(found - truth).mean())


def test_level_and_steep_surfaces_have_their_own_incidence():
    def truth(seen):
        _, ranges_m, incidence, kind = seen
        lobe = np.exp(-0.5 * (incidence / 0.2) ** 2)
        return (
            0.8 - 0.2 * np.log10(ranges_m) - np.where(kind == LEVEL, 0.1 * incidence, -0.4 * lobe)
        ).astype(np.float32)

    seen, asked = views(), views(1)
    assert truth(seen).std() > 0.1
    assert error(truth(seen), seen, asked, truth(asked)) < 0.005


def test_ground_between_scans_is_predicted_by_its_height():
    """A sum of functions of range and elevation cannot represent a plane 1.5 m below the sensor."""

    def truth(seen):
        directions, ranges_m = seen[:2]
        return np.where(ranges_m * directions[:, 2] < -1.5, np.float32(0.3), np.float32(0.7))

    seen, asked = views(kinds=(LEVEL, STEEP)), views(1, kinds=(NO_SURFACE,))
    assert error(truth(seen), seen, asked, truth(asked)) < 0.03


def test_the_kind_of_surface_follows_the_plane():
    normals = np.array([[0, 0, 1], [0.6, 0, -0.8], [0.8, 0, 0.6], [1, 0, 0]], np.float32)
    found = kinds_of(normals, np.array([0, 1, 2, 3, -1], np.int32))
    assert found.tolist() == [LEVEL, LEVEL, STEEP, STEEP, NO_SURFACE]
    assert kinds_of(normals[:0], np.array([-1], np.int32)).tolist() == [NO_SURFACE]


N = 20_000


def decibels(rng):
    """Intensities in steps of half a decibel above a threshold, as of automotive radars."""
    return np.round(2 * (45 + rng.gamma(1.2, 6, N))) / 2


USUAL = {
    "dB": decibels,
    "linear": lambda rng: 10 ** (decibels(rng) / 10),
    "lognormal": lambda rng: rng.lognormal(0, 2.3, N),
    "exponential": lambda rng: rng.exponential(size=N),
    "Gaussian": lambda rng: rng.normal(-3, 5, N),
    "radar equation": lambda rng: rng.uniform(1, 100, N) ** -4.0,
    "bytes": lambda rng: np.clip(np.round(rng.normal(90, 60, N)), 0, 255),
    "clipped": lambda rng: np.minimum(decibels(rng), 50),
    "mostly one value": lambda rng: np.where(rng.random(N) < 0.9, 0, rng.normal(30, 8, N)),
    "few values": lambda rng: rng.integers(0, 3, N),
    "few returns of another kind": lambda rng: np.where(
        rng.random(N) < 0.01, rng.normal(90, 3, N), rng.normal(50, 8, N)
    ),
}


@pytest.mark.parametrize("values", USUAL.values(), ids=USUAL)
def test_homogeneous_intensities_have_no_outliers(values):
    for seed in range(5):
        intensities = values(np.random.default_rng(seed)).astype(np.float32)
        assert Plausible.of(intensities).holds(intensities).all()


WILD = {
    "one of 1e9": (0, [1e9]),
    "one of -9999": (0, [-9999]),
    "-9999": (0.01, [-9999]),
    "65535": (0.01, [65535]),
    "999": (0.01, [999]),
    "-9999 in two of five": (0.4, [-9999]),
    "two sentinels": (0.2, [-9999, -32768]),
    "at both ends": (0.1, [-9999, 65535]),
    "garbage": (0.02, np.linspace(-1e9, 1e9, 1000)),
    "a sentinel and garbage": (0.02, np.append(np.linspace(-1e30, 1e30, 500), np.full(500, -9999))),
}


@pytest.mark.parametrize("case", WILD.values(), ids=WILD)
def test_only_outliers_are_excluded(case):
    share, values = case
    rng = np.random.default_rng(1)
    intensities = decibels(rng).astype(np.float32)
    rows = rng.choice(N, max(1, round(share * N)), replace=False)
    intensities[rows] = rng.choice(values, len(rows))
    held = Plausible.of(intensities).holds(intensities)
    np.testing.assert_array_equal(np.flatnonzero(~held), np.sort(rows))


@pytest.mark.parametrize("most", [1 << 15, 2000], ids=["all", "some"])
def test_limits_of_parts_equal_those_of_the_whole(monkeypatch, most):
    monkeypatch.setattr(plausible, "_MOST", most)
    intensities = decibels(np.random.default_rng(0)).astype(np.float32)
    intensities[12_345] = 1e9  # a sample may miss it
    parts = Intensities()
    keys = np.random.default_rng(1).permutation(len(intensities)).astype(np.uint64)
    for rows in np.split(np.arange(len(intensities))[::-1], [10, 10, 3000, 9001]):
        parts.add(intensities[rows], keys[rows])
    found = parts.plausible()
    assert found == Plausible.of(intensities, keys)
    assert np.flatnonzero(~found.holds(intensities)).tolist() == [12_345]
    assert (parts.low, parts.high) == (45, 1e9)


@pytest.mark.parametrize("many", [False, True])
def test_intensities_do_not_depend_on_the_order_of_scans(monkeypatch, many):
    if many:
        for module, name, value in (
            (steps, "_ENOUGH_RETURNS", 3000), (steps, "_ENOUGH_PER_PLANE", 0), (plausible, "_MOST", 1000),
            (reflectance, "_MOST_RETURNS", 1000), (sensor, "_MAX_RETURNS", 1000),
        ):  # fmt: skip
            monkeypatch.setattr(module, name, value)
    scans = radarsdf.simulate.wall(frames=12, seed=2)
    given = scans.points, scans.poses, scans.intensities
    quick = radarsdf.FitConfig.quick()
    one, other = (
        radarsdf.fit(*(column[::step] for column in given), config=quick, progress=False) for step in (1, -1)
    )
    x, viewpoint = one.mesh(progress=False).vertices, scans.poses[3, :3, 3]
    np.testing.assert_array_equal(one.intensity(x, viewpoint), other.intensity(x, viewpoint))
    assert one.sensor.range_m == other.sensor.range_m
    assert one.sensor.thresholds == other.sensor.thresholds
