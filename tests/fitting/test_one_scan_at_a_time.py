# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map of scans that come one after another, and may be taken out again, goes through the steps of a fit of all at once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import ScanSums

from ..conftest import ground_and_wall

ORIGIN = (2.0, 0.0, 1.0)
PRESETS = {
    "quick": FitConfig.quick(num_threads=1),
    "default": FitConfig(num_threads=1, training={"sdf_iterations": 3}),
}


class OneAtATime:
    """The least that a live map keeps: the rays of each scan, and one sum over all."""

    def __init__(self, config):
        self._config, self._scans, self._sums = config, {}, None

    def integrate(self, number, points, pose):
        rays = prepare([points], pose[None], origin=ORIGIN, whole=False, **self._config.preparation)
        sums = ScanSums.of(rays, self._config.leaf_size_m)
        self._scans[number] = rays, pose, sums
        self._sums = sums if self._sums is None else self._sums + sums

    def remove(self, number):
        self._sums = self._sums - self._scans.pop(number)[2]

    def map(self):
        scans = [self._scans[number] for number in sorted(self._scans)]
        parts = [dataclasses.replace(rays, scans=rays.scans + i) for i, (rays, *_) in enumerate(scans)]
        names = ("points", "directions", "ranges_m", "scans", "up_of_scan")
        joined = {name: np.concatenate([getattr(rays, name) for rays in parts]) for name in names}
        rays = dataclasses.replace(parts[0], **joined, num_given=sum(part.num_given for part in parts))
        poses = np.stack([pose for _, pose, _ in scans])
        given = FitInput(rays, None, poses, sums=self._sums)
        return fit_rays(lambda: given, self._config, progress=False)


def bits(radar_map):
    evidence = radar_map.evidence
    arrays = [parameter.detach().numpy() for parameter in radar_map.field.parameters()]
    return [array.tobytes() for array in [*arrays, evidence.information, evidence.detections, evidence.looks]]


@pytest.mark.parametrize("preset", PRESETS)
def test_scans_in_any_order_and_one_taken_out_are_a_fit_of_the_others(preset):
    scene, config = ground_and_wall(), PRESETS[preset]
    growing = OneAtATime(config)
    for i in np.random.default_rng(0).permutation(len(scene.points)):
        growing.integrate(i, scene.points[i], scene.poses[i])
    all_at_once = radarsdf.fit(scene.points, scene.poses, config=config, origin=ORIGIN, progress=False)
    assert bits(growing.map()) == bits(all_at_once)
    growing.remove(2)
    kept = [i for i in range(len(scene.points)) if i != 2]
    without = radarsdf.fit(
        [scene.points[i] for i in kept], scene.poses[kept], config=config, origin=ORIGIN, progress=False
    )
    assert bits(growing.map()) == bits(without) != bits(all_at_once)
