"""Drives past a wall, before and after changes next to it."""

import pytest
import radarsdf
from radarsdf.simulate import Scene, simulate

QUICK = radarsdf.FitConfig.quick(returns={"free_space": True})


def drives_past(before, after):
    """A drive past a wall with the solids `before`, one without changes, and one with `after` instead."""
    drive = radarsdf.simulate.wall(frames=24)
    other = drive.poses.copy()
    other[:, 1, 3] += 0.3
    scenes = [Scene([*drive.scene.solids, *extra], drive.scene.terrain) for extra in (before, after)]
    return [
        simulate(scene, drive.sensor, poses, name="wall", seed=seed)
        for scene, poses, seed in ((scenes[0], drive.poses, 1), (scenes[0], other, 2), (scenes[1], other, 3))
    ]


@pytest.fixture(scope="module")
def maps(drives):
    """Maps of the `drives` of a module."""
    return [radarsdf.fit(drive.points, drive.poses, drive.intensities, config=QUICK) for drive in drives]


@pytest.fixture(scope="module")
def changes(maps):
    """Changes from the first map to the last."""
    return radarsdf.compare(maps[0], maps[2])
