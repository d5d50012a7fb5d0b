# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The default fit and the quick one are no worse than they were, beyond what chance explains; and worse is noticed."""

import functools
import math

import pytest

from .floors import (
    KINDS,
    MEASURED,
    RECORDED,
    SIMULATED,
    VOXEL_M,
    Quality,
    config_of,
    failures,
    jittered,
    limits,
    load,
    measure,
    report,
    swapped,
    untrained,
    with_ghosts,
)

scene_of = functools.cache(load)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [*SIMULATED, *RECORDED])
def test_a_fit_is_no_worse_than_its_floor(name, kind):
    scene = scene_of(name)
    limit = limits(*MEASURED[name, kind])
    quality = measure(scene, config_of(kind, scene), VOXEL_M[kind])
    report(name, kind, quality, limit)
    assert failures(quality, limit) == []


@pytest.mark.parametrize(
    ("spoilt", "kind", "what_fails"),
    [
        (functools.partial(jittered, sigma_m=0.1), "default", ["f_score", "outliers"]),
        (with_ghosts, "default", ["f_score", "outliers"]),
        (untrained, "default", ["f_score", "outliers", "mae"]),
        (swapped, "quick", ["mae"]),
    ],
    ids=["jitter of 10 cm", "ghosts", "untrained", "swapped"],
)
def test_a_fit_that_is_bad_on_purpose_fails(spoilt, kind, what_fails):
    quality = spoilt(kind, scene_of("oculii"))
    assert failures(quality, limits(*MEASURED["oculii", kind])) == what_fails


@pytest.mark.parametrize(
    ("quality", "names"),
    [
        (Quality(88.1, 6.9, 4.7), []),
        (Quality(87.9, 6.9, 4.7), ["f_score"]),
        (Quality(88.1, 7.1, 4.7), ["outliers"]),
        (Quality(88.1, 6.9, 4.9), ["mae"]),
        (Quality(math.nan, math.nan, math.nan), ["f_score", "outliers", "mae"]),
    ],
)
def test_each_number_can_fail_alone(quality, names):
    assert failures(quality, limits((91.0, 4.0, 4.2), (1.0, 1.0, 0.2))) == names
