# The public names and where they are, for `__init__.py`, which reads the lines as they are, and for type checkers.

from . import evaluation as evaluation
from . import io as io
from . import simulate as simulate
from .changes.changes import Changes as Changes
from .changes.changes import compare as compare
from .checking.check import check as check
from .checking.recording import Finding as Finding
from .config.fit_config import FitConfig as FitConfig
from .fitting.estimate import Estimate as Estimate
from .fitting.estimate import estimate as estimate
from .fitting.fit import fit as fit
from .fitting.train import Diverged as Diverged
from .fitting.train import Interrupted as Interrupted
from .grids.grid import Grid as Grid
from .grids.occupancy import grid as grid
from .live.live_map import LiveMap as LiveMap
from .map.map import Map as Map
from .map.marching_cubes import marching_cubes as marching_cubes
from .map.radar_map import RadarMap as RadarMap
from .poses.calibrate import Calibration as Calibration
from .poses.calibrate import Mounting as Mounting
from .poses.calibrate import calibrate as calibrate
from .poses.join import Joined as Joined
from .poses.join import join as join
from .poses.locate import Localisation as Localisation
from .poses.locate import locate as locate
from .poses.odometry import Odometry as Odometry
from .poses.odometry import odometry as odometry
from .poses.refine import RefinedPoses as RefinedPoses
from .poses.refine import refine_poses as refine_poses
from .poses.search import Lost as Lost
from .poses.search import SurfaceIndex as SurfaceIndex
from .tiles.fit_tiles import fit_tiles as fit_tiles
from .tiles.tiled_map import TiledMap as TiledMap
from .tiles.tiled_map import load as load

__version__: str
