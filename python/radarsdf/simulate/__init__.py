"""Simulated radar scans of worlds whose true surface is known.

`SCENES` holds the ready-made simulations by name. `simulate` scans your own `Scene` with a `RadarSensor`,
`simulate_rig` with several radars on one body.

Examples
--------
>>> from radarsdf.simulate import hugin
>>> simulation = hugin(seed=1, frames=2)
>>> len(simulation), simulation.poses.shape
(2, (2, 4, 4))
"""

from .materials import Material
from .motion import (
    MeasuredMotion,
    MountedRadar,
    SimulatedRig,
    drifted,
    measured_imu,
    measured_motion,
    simulate_rig,
)
from .radar import Origin, RadarSensor, SimulatedScan, Simulation, simulate
from .scenes import SCENES, astyx, hugin, oculii, wall
from .world import Box, CornerReflector, Hits, Pole, Primitive, Scene, Terrain

__all__ = [
    "SCENES", "Box", "CornerReflector", "Hits", "Material", "MeasuredMotion", "MountedRadar", "Origin", "Pole",
    "Primitive", "RadarSensor", "Scene", "SimulatedRig", "SimulatedScan", "Simulation", "Terrain", "astyx", "drifted", "hugin",
    "measured_imu", "measured_motion", "oculii", "simulate", "simulate_rig", "wall",
]  # fmt: skip
