"""A small city for tests: a wall along a drive, averaged in tiles of 12.8 m."""

import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.io import Scans

TILE_M = 12.8
# No bridges: estimates do not count them.
CONFIG = FitConfig.quick(num_threads=1, encoding={"bridge_cells": 0})


def scans_of(simulation, with_intensities=True):
    intensities = simulation.intensities if with_intensities else None
    return Scans(simulation.points, simulation.poses, intensities, simulation.ground_truth)


@pytest.fixture(scope="session")
def drive():
    return scans_of(radarsdf.simulate.wall(seed=5, frames=12))


@pytest.fixture(scope="session")
def folder(drive, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles") / "city"
    radarsdf.fit_tiles(drive, out, tile_size=TILE_M, halo=6.4, config=CONFIG, progress=False)
    return out


@pytest.fixture
def city(folder):
    return radarsdf.load(folder)
