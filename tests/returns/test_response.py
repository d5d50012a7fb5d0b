# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How strong a return is by range, elevation, incidence and the kind of surface."""

import numpy as np
from radarsdf.returns.response import LEVEL, NO_SURFACE, STEEP, Response, kinds_of

COUNT = 6000


def views(seed=0, kinds=(LEVEL, STEEP), count=COUNT):
    """Directions, ranges, incidences and kinds of surfaces of random returns, as :meth:`Response.at` takes them."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = rng.uniform(-0.4, 0.4, count), rng.uniform(-1, 1, count)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    kind = rng.choice(np.array(kinds, np.int8), count)
    incidence = np.where(kind == NO_SURFACE, np.nan, rng.uniform(0, 1.4, count))
    return (
        directions.astype(np.float32),
        rng.uniform(2, 40, count).astype(np.float32),
        incidence.astype(np.float32),
        kind,
    )


def error(values, seen, asked=None, truth=None):
    """Mean absolute error of what `values` of returns tell."""
    asked, truth = (seen, values) if asked is None else (asked, truth)
    return float(np.abs(Response.of(values, *seen).at(*asked) - truth).mean())


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


def test_where_no_scan_was_the_ground_is_known_by_its_height():
    """A sum of functions of range and elevation cannot tell what is 1.5 m below the sensor."""

    def truth(seen):
        directions, ranges_m = seen[:2]
        return np.where(ranges_m * directions[:, 2] < -1.5, np.float32(0.3), np.float32(0.7))

    seen, asked = views(kinds=(LEVEL, STEEP)), views(1, kinds=(NO_SURFACE,))
    assert error(truth(seen), seen, asked, truth(asked)) < 0.03


def test_a_kind_is_that_of_the_plane():
    normals = np.array([[0, 0, 1], [0.6, 0, -0.8], [0.8, 0, 0.6], [1, 0, 0]], np.float32)
    found = kinds_of(normals, np.array([0, 1, 2, 3, -1], np.int32))
    assert found.tolist() == [LEVEL, LEVEL, STEEP, STEEP, NO_SURFACE]
    assert kinds_of(normals[:0], np.array([-1], np.int32)).tolist() == [NO_SURFACE]
