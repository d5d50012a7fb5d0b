# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Simulated radar scans of worlds whose true surface is known.

`SCENES` holds the ready-made simulations by name. `simulate` scans your own `Scene` with a `RadarSensor`.

Examples
--------
>>> from radarsdf.simulate import hugin
>>> simulation = hugin(seed=1, frames=2)
>>> len(simulation), simulation.poses.shape
(2, (2, 4, 4))
"""

from .drift import drifted
from .legs import Leg, LegDrive, drive_legs
from .materials import Material
from .measured_imu import measured_imu
from .measured_motion import MeasuredMotion, measured_motion
from .primitives import Box, CornerReflector, Pole, Primitive
from .radar import Origin, RadarSensor, Scan
from .scene import Hits, Scene
from .simulation import Simulation, simulate
from .terrain import Terrain
from .worlds import SCENES, astyx, hugin, oculii, wall

__all__ = [
    "SCENES",
    "Box",
    "CornerReflector",
    "Hits",
    "Leg",
    "LegDrive",
    "Material",
    "MeasuredMotion",
    "Origin",
    "Pole",
    "Primitive",
    "RadarSensor",
    "Scan",
    "Scene",
    "Simulation",
    "Terrain",
    "astyx",
    "drifted",
    "drive_legs",
    "hugin",
    "measured_imu",
    "measured_motion",
    "oculii",
    "simulate",
    "wall",
]
