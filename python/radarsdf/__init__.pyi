# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
# The public names and where they are, for lazy_loader and for type checkers.

from . import evaluation as evaluation
from . import io as io
from . import simulate as simulate
from .budget.estimate import Estimate as Estimate
from .budget.estimate import estimate as estimate
from .changes.changes import Changes as Changes
from .changes.compare import compare as compare
from .checking.check import check as check
from .checking.finding import Finding as Finding
from .config.fit_config import FitConfig as FitConfig
from .fitting.fit import fit as fit
from .fitting.stopping import Diverged as Diverged
from .fitting.stopping import Interrupted as Interrupted
from .live.live_map import LiveMap as LiveMap
from .map.isosurface import marching_cubes as marching_cubes
from .map.map import Map as Map
from .map.radar_map import RadarMap as RadarMap
from .poses.odometry import Odometry as Odometry
from .poses.odometry import odometry as odometry
from .poses.refine import RefinedPoses as RefinedPoses
from .poses.refine import refine_poses as refine_poses
from .tiles.fit_tiles import fit_tiles as fit_tiles
from .tiles.tiled_map import TiledMap as TiledMap
from .tiles.tiled_map import load as load

__version__: str
