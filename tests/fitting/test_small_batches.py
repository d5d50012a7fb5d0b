# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Batches that give the threads parts of different sizes, or none: the loss is the mean over the whole batch."""

from __future__ import annotations

import math

import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.fitting.sampling import RaySampler
from radarsdf.returns.rays import prepare

SETTINGS = {
    "returns": {"drop_ghosts": False, "onto_planes": False},
}


STAGES = {  # of one iteration: a step of Adam makes much of a rounding
    "joint": {"sdf_iterations": 1, "intensity_iterations": 1},
    "joint in free space": {"sdf_iterations": 1, "intensity_iterations": 1, "intensity_in_free_space": True},
    "frozen": {"sdf_iterations": 0, "intensity_iterations": 1, "joint": False},
}


def losses(scene, threads, **training):
    config = FitConfig(num_threads=threads, training=training).override(**SETTINGS)
    few = [values[:2] for values in (scene.points, scene.poses, scene.intensities)]
    report = radarsdf.fit(*few, config=config, progress=False).report
    assert report["iterations_done"] == report["iterations"]
    return report["losses"]


@pytest.mark.parametrize("gradients", ["core", "autograd"])
@pytest.mark.parametrize("batch_size", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("stage", STAGES)
def test_the_loss_does_not_depend_on_the_threads(scene, gradients, batch_size, stage):
    training = {"gradients": gradients, "batch_size": batch_size, "intensity_batch_size": batch_size}
    found = [losses(scene, threads, **training, **STAGES[stage]) for threads in (1, 3, 16)]
    assert all(math.isfinite(value) for one in found for value in one.values())
    for one in found[1:]:
        assert one == pytest.approx(found[0], rel=1e-5)


def test_normals_of_no_samples(scene):
    config = FitConfig(num_threads=3, networks={"normals": True}, training={"batch_size": 4})
    config = config.override(
        training={"sdf_iterations": 2, "intensity_iterations": 4, "intensity_batch_size": 4}
    )
    report = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False).report
    assert all(math.isfinite(loss) for loss in report["losses"].values())


@pytest.mark.parametrize("batch_size", [1, 3, 5, 101, 4096])
@pytest.mark.parametrize("parts", [1, 2, 3, 16])
def test_parts_count_by_their_samples(scene, batch_size, parts):
    rays = prepare(scene.points, scene.poses)
    draw = RaySampler(rays, FitConfig(), batch_size, torch.Generator().manual_seed(0))
    for batch in (draw.batch(parts).split(), draw.spread(batch_size, parts).split()):
        sizes, labelled = [len(part.points) for part in batch], [part.num_labelled for part in batch]
        assert [part.share for part in batch] == [size / sum(sizes) for size in sizes]
        assert [part.labelled_share for part in batch] == [count / sum(labelled) for count in labelled]
        if len(set(sizes)) == 1:  # as it was when a part was taken for the parts-th of a batch
            assert {part.share for part in batch} == {1 / parts}
