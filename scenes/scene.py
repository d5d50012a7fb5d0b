"""Scenes of experiments and tests of quality: simulated ones, and recorded ones from files and folders."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import ArrayLike, NDArray
from radarsdf import FitConfig, RadarMap
from radarsdf.checks import check_box
from radarsdf.evaluation import holdout
from radarsdf.io import read
from radarsdf.io.datasets import find_dataset
from radarsdf.io.npz import read_scans
from radarsdf.returns.rays import Rays, prepare
from radarsdf.scans import Scans
from radarsdf.simulate import SCENES, Simulation
from scipy.spatial import cKDTree

from scenes.kinds import KINDS
from scenes.settings import PRESETS, Changes, merged

SEEN_BY_RADAR_M = 1.0
"""Radius of ground truth around the radar's returns: a lidar sees in all directions, and farther points are ignored."""

VOXEL_M = {"default": 0.1, "quick": 0.2}
"""Edge of the voxels in which meshes of each kind of map are evaluated, m."""

_MIN_RANGE_M = 2.5
_MIN_RANGE_OCULII_M = 1.0
_MAX_RANGE_FILE_M = 60.0
_HOLDOUT_EVERY = 10
_HOLDOUT_EVERY_SHORT = 5
_SHORT_FRAMES = 50  # below this, every tenth scan would be too few for a test

QUICK: Changes = {"training": {"sdf_iterations": 60, "intensity_iterations": 60}}
"""Settings of a quick run. After 20 iterations, some scenes have no surface yet."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """F scans of one place with N_i returns in scan i, its ground truth, and settings of the experiments."""

    name: str
    points: list[NDArray[np.float32]]
    """F arrays (N_i, 3), sensor frame, m."""
    poses: NDArray[np.float64]
    """(F, 4, 4) T_world_sensor, m."""
    intensities: list[NDArray[np.float32]] | None
    """F arrays (N_i,), sensor units."""
    ground_truth: NDArray[np.float64] | None = None
    """(M, 3) lidar points, world frame, m."""
    box: NDArray[np.float64] | None = None
    """(2, 3) lower and upper corner of the region for the surface errors, world frame, m. None: everywhere."""
    holdout_every: int = _HOLDOUT_EVERY
    """Scans 0, `holdout_every`, 2 · `holdout_every`, … are held out."""
    min_range_m: float = _MIN_RANGE_M
    """Setting of `FitConfig`: nearer returns are dropped by the fit. `points` still holds them."""
    max_range_m: float | None = None
    """Setting of `FitConfig`: farther returns are dropped by the fit. None: no limit."""
    simulation: Simulation | None = None
    """Ground truth of the same scans if the scene is simulated."""
    doppler_mps: list[NDArray[Any]] | None = None
    """F arrays (N_i,), m/s, of a recorded scene."""
    times_s: NDArray[np.float64] | None = None
    """(F,) of a recorded scene, s."""

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.points)

    @property
    def num_returns(self) -> int:
        """Number of returns of all scans."""
        return sum(map(len, self.points))

    @property
    def ranges(self) -> dict[str, Any]:
        """Settings of the range limits of a fit."""
        return {"min_range_m": self.min_range_m, "max_range_m": self.max_range_m}

    def config(self, preset: str, *, quick: bool = False, **changes: Any) -> FitConfig:
        """Preset of `PRESETS` with the ranges of the scene, `QUICK` settings if requested, and other changes."""
        return (
            PRESETS[preset].override(returns=self.ranges).override(**merged(QUICK if quick else {}, changes))
        )

    def fit(self, config: FitConfig) -> RadarMap:
        """Fit all scans, with intensities if the scene has them."""
        return radarsdf.fit(self.points, self.poses, self.intensities, config=config, progress=False)

    def rays(self) -> Rays:
        """The returns within the ranges of the scene."""
        return prepare(self.points, self.poses, self.intensities, **self.ranges)

    def world_returns(self) -> tuple[Floats, Floats, NDArray[Any]]:
        """Points (N, 3) and sensor positions (N, 3), world frame, m, and intensities (N,), sensor units, within the ranges."""
        rays = self.rays()
        assert rays.intensities is not None
        return *rays.in_world(), rays.intensities

    def is_used(self, frame: int) -> NDArray[np.bool_]:
        """(N_i,) whether the returns of a scan are within the ranges."""
        range_m = np.linalg.norm(self.points[frame].astype(np.float64), axis=1)
        used: NDArray[np.bool_] = (range_m >= self.min_range_m) & (range_m <= (self.max_range_m or np.inf))
        return used

    def every_nth(self, n: int) -> "Scene":
        """The scans 0, n, 2n, … with the whole ground truth."""
        return self._select(np.arange(0, len(self), n))

    def first(self, n: int) -> "Scene":
        """The first `n` scans with the whole ground truth."""
        return self._select(np.arange(n))

    def repeated(self, repetition: int) -> "Scene":
        """The simulated scene with another seed, since fits with other seeds repeat most errors; a recorded one unchanged."""
        if self.simulation is None or repetition == 0:
            return self
        other = load_scene(self.name, frames=len(self), seed=self.simulation.seed + repetition)
        return dataclasses.replace(other, box=self.box)

    def without_intensities(self) -> "Scene":
        """The scene without intensities."""
        return dataclasses.replace(self, intensities=None)

    def split(self) -> "tuple[Scene, Scene]":
        """The scans to fit, and the held-out scans; see `holdout_every`."""
        train, test = holdout(len(self), self.holdout_every)
        return self._select(train), self._select(test)

    def _select(self, frames: NDArray[np.int64]) -> "Scene":
        scans = Scans(
            self.points, self.poses, self.intensities, doppler_mps=self.doppler_mps, times_s=self.times_s
        ).select(frames)
        simulation = self.simulation
        if simulation is not None:
            simulation = dataclasses.replace(
                simulation,
                points=scans.points,
                poses=scans.poses,
                intensities=scans.intensities or [],
                noiseless_intensities=[simulation.noiseless_intensities[i] for i in frames],
                origin_kind=[simulation.origin_kind[i] for i in frames],
            )
        return dataclasses.replace(
            self,
            points=scans.points,
            poses=scans.poses,
            intensities=scans.intensities,
            simulation=simulation,
            doppler_mps=scans.doppler_mps,
            times_s=scans.times_s,
        )


def load_scene(spec: str, *, frames: int | None = None, seed: int = 0, box: ArrayLike | None = None) -> Scene:
    """Load a scene.

    Parameters
    ----------
    spec : str
        One of

        - the name of a simulated scene in `radarsdf.simulate.SCENES` or `scenes.kinds.KINDS`;
        - an ``.npz`` file for :func:`radarsdf.io.npz.read_scans`. Only lidar points within 1 m of a return that is
          2.5 to 60 m from its sensor are ground truth, unless an array ``box`` (2, 3) says where it is complete;
        - a folder of scans with poses for :func:`radarsdf.io.read`, such as a recording of Viking Hill. All its lidar
          points are ground truth; `box` selects a region.
    frames : int, optional
        Number of scans. A simulated scene has them along its whole path; a recorded scene is cut to the first ones.
    seed : int
        Seed of a simulated scene.
    box : (2, 3) or (6,) array_like, optional
        Lower and upper corner of the region for the surface errors, world frame, m.

    Raises
    ------
    ValueError
        If there is no such scene, its files are damaged or of another format, or `box` is not a box.
    OSError
        If a file cannot be read.
    """
    simulations = {**SCENES, **KINDS}
    if spec in simulations:
        scene = _simulated(simulations[spec](seed=seed, frames=frames))
    elif Path(spec).is_file() and Path(spec).suffix == ".npz":
        scene = _file(Path(spec), frames)
    elif Path(spec).is_dir():
        scene = _folder(Path(spec), frames)
    else:
        names = ", ".join(sorted(simulations))
        msg = f"no scene {spec!r}: expected a simulated scene ({names}), an .npz file of scans, or a folder of scans with poses"
        raise ValueError(msg)
    return scene if box is None else dataclasses.replace(scene, box=check_box(np.reshape(box, (2, 3))))


def _simulated(simulation: Simulation) -> Scene:
    return Scene(
        name=simulation.name,
        points=simulation.points,
        poses=simulation.poses,
        intensities=simulation.intensities,
        ground_truth=simulation.ground_truth,
        min_range_m=_MIN_RANGE_OCULII_M if simulation.name == "oculii" else _MIN_RANGE_M,
        simulation=simulation,
    )


def _file(path: Path, frames: int | None) -> Scene:
    scans = read_scans(path)
    scene = _recorded(path.stem, scans, frames)
    with np.load(path) as arrays:
        if "box" in arrays:
            return dataclasses.replace(scene, box=check_box(arrays["box"]))
    scene = dataclasses.replace(
        scene,
        holdout_every=_HOLDOUT_EVERY_SHORT if len(scans.points) < _SHORT_FRAMES else _HOLDOUT_EVERY,
        max_range_m=_MAX_RANGE_FILE_M,
    )
    return dataclasses.replace(scene, ground_truth=_seen_by_both(scene))


def _folder(path: Path, frames: int | None) -> Scene:
    scene = _recorded(path.resolve().name, read(path), frames)
    is_snail_radar = (dataset := find_dataset(path)) is not None and dataset.name == "SNAIL-Radar"
    return dataclasses.replace(scene, min_range_m=_MIN_RANGE_OCULII_M) if is_snail_radar else scene


def _recorded(name: str, scans: Scans, frames: int | None) -> Scene:
    kept = scans.select(np.arange(len(scans.points))[:frames])
    intensities = kept.intensities
    return Scene(
        name=name,
        points=[np.asarray(p, np.float32) for p in kept.points],
        poses=kept.poses,
        intensities=None if intensities is None else [np.asarray(v, np.float32) for v in intensities],
        ground_truth=None if kept.ground_truth is None else np.asarray(kept.ground_truth, np.float64),
        doppler_mps=kept.doppler_mps,
        times_s=kept.times_s,
    )


def _seen_by_both(scene: Scene) -> NDArray[np.float64] | None:
    """Lidar points (M, 3), world frame, m, within `SEEN_BY_RADAR_M` of a return within the ranges of the scene."""
    lidar = scene.ground_truth
    if lidar is None:
        return None
    rays = prepare(scene.points, scene.poses, **scene.ranges)
    distance, _ = cKDTree(rays.points + rays.origin).query(lidar, distance_upper_bound=SEEN_BY_RADAR_M)
    seen: NDArray[np.float64] = lidar[distance <= SEEN_BY_RADAR_M]
    return seen
