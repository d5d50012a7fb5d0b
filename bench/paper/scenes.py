# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scenes on which the experiments run, all in one form: simulated ones, files and folders of recorded ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from radarsdf.evaluation import holdout
from radarsdf.io.folders import is_posed_folder, is_snail_radar, read_posed_folder, read_snail_radar
from radarsdf.io.scans import Scans, read_scans
from radarsdf.returns.rays import prepare
from radarsdf.simulate import SCENES, Simulation
from scipy.spatial import cKDTree

SEEN_BY_RADAR_M = 1.0
"""Lidar sees all round: a lidar point further than this from every return says nothing about a radar map."""

# What returns nearer or further than these are dropped, and every how many-th scan is held out.
_MIN_RANGE_M = 2.5
_MIN_RANGE_OCULII_M = 1.0
_MAX_RANGE_FILE_M = 60.0
_HOLDOUT_EVERY = 10
_HOLDOUT_EVERY_SHORT = 5
_SHORT_FRAMES = 50  # every tenth of fewer scans would be too few to measure on


@dataclass(frozen=True, eq=False)
class Scene:
    """Scans of one place, with what is known about it and how it is to be used.

    F frames, N_i returns in frame i.
    """

    name: str
    points: list[NDArray[np.float32]]
    """F arrays (N_i, 3), sensor frame, m."""
    poses: NDArray[np.float64]
    """(F, 4, 4) T_world_sensor."""
    intensities: list[NDArray[np.float32]] | None
    """F arrays (N_i,), sensor units."""
    ground_truth: NDArray[np.float64] | None = None
    """(M, 3) lidar points, world, m."""
    box: NDArray[np.float64] | None = None
    """(2, 3) lower and upper corner of what is evaluated, world, m. None: everything is."""
    holdout_every: int = _HOLDOUT_EVERY
    """The first frame and then every so many-th is for testing."""
    min_range_m: float = _MIN_RANGE_M
    """Returns nearer than this are for `FitConfig` to drop: `points` holds them."""
    max_range_m: float | None = None
    """Returns further than this, likewise. None: none are dropped."""
    simulation: Simulation | None = None
    """Where the scene is simulated: the same frames, with everything a recorded scene does not tell."""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.points)

    def every_nth(self, n: int) -> Scene:
        """The frames 0, n, 2n, …; the ground truth stays whole.

        Raises
        ------
        ValueError
            If `n` is below 1.
        """
        if n < 1:
            msg = f"n must be at least 1, not {n}"
            raise ValueError(msg)
        return self._select(np.arange(0, len(self), n))

    def without_intensities(self) -> Scene:
        """The geometry only."""
        return dataclasses.replace(self, intensities=None)

    def split(self) -> tuple[Scene, Scene]:
        """The frames to fit, and the held-out ones: the first and then every `holdout_every`-th.

        Raises
        ------
        ValueError
            If the scene has fewer than two frames.
        """
        train, test = holdout(len(self), self.holdout_every)
        return self._select(train), self._select(test)

    def _select(self, frames: NDArray[np.int64]) -> Scene:
        scans = Scans(self.points, self.poses, self.intensities).select(frames)
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
        )


def load_scene(spec: str, *, frames: int | None = None, seed: int = 0, box: ArrayLike | None = None) -> Scene:
    """Loads a scene.

    Parameters
    ----------
    spec : str
        One of

        - the name of a simulated scene, of `radarsdf.simulate.SCENES`;
        - an ``.npz`` file as :func:`radarsdf.io.scans.read_scans` reads it: only static returns are used, and of the
          lidar points those within 1 m of a return that is 2.5 to 60 m from its sensor;
        - a folder as :func:`.folders.read_posed_folder` reads it: recordings of Viking Hill, exported from ROS bags;
        - a sequence of SNAIL-Radar as :func:`.folders.read_snail_radar` reads it.

        The ground truth of a folder is all of it: `box` is for cutting it.
    frames : int, optional
        How many: a simulated scene has so many along its whole path, a recorded one the first so many.
    seed : int
        Of a simulated scene; recorded ones ignore it.
    box : array_like, optional
        (2, 3) lower and upper corner of what is to be evaluated, world, m.

    Raises
    ------
    ValueError
        If there is no such scene, its files are damaged or of another kind, or `frames` is below 2 (one of them is
        held out) or `box` no box.
    OSError
        If a file cannot be read.
    """
    if frames is not None and frames < 2:
        msg = f"frames must be at least 2, one of them to be held out, not {frames}"
        raise ValueError(msg)
    if spec in SCENES:
        scene = _simulated(SCENES[spec](seed=seed, frames=frames))
    elif Path(spec).is_file() and Path(spec).suffix == ".npz":
        scene = _file(Path(spec), frames)
    elif is_snail_radar(Path(spec)):
        scene = _recorded(Path(spec).resolve().name, read_snail_radar(Path(spec), frames), frames)
        scene = scene.override(returns={"min_range_m": _MIN_RANGE_OCULII_M})
    elif is_posed_folder(Path(spec)):
        scene = _recorded(Path(spec).resolve().name, read_posed_folder(Path(spec), frames), frames)
    else:
        msg = (
            f"no scene {spec!r}: expected a simulated scene ({', '.join(sorted(SCENES))}), an .npz file of scans, "
            "a folder with radar/*.pcd and poses.txt (ROS bags, such as Viking Hill's, must be exported to one) or "
            "a sequence of SNAIL-Radar with eagleg7/enhanced/*.pcd and utm50r_T_xt32.txt"
        )
        raise ValueError(msg)
    return scene if box is None else dataclasses.replace(scene, box=_corners(box))


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
    scene = scene.override(
        holdout_every=_HOLDOUT_EVERY_SHORT if len(scans.points) < _SHORT_FRAMES else _HOLDOUT_EVERY,
        returns={"max_range_m": _MAX_RANGE_FILE_M},
    )
    return dataclasses.replace(scene, ground_truth=_seen_by_both(scene))


def _recorded(name: str, scans: Scans, frames: int | None) -> Scene:
    kept = scans.select(np.arange(len(scans.points))[:frames])
    intensities = kept.intensities
    return Scene(
        name=name,
        points=[np.asarray(p, np.float32) for p in kept.points],
        poses=kept.poses,
        intensities=None if intensities is None else [np.asarray(v, np.float32) for v in intensities],
        ground_truth=None if kept.ground_truth is None else np.asarray(kept.ground_truth, np.float64),
    )


def _seen_by_both(scene: Scene) -> NDArray[np.float64] | None:
    """The lidar points, (M, 3) world m, within 1 m of a return that the scene's ranges keep."""
    lidar = scene.ground_truth
    if lidar is None:
        return None
    rays = prepare(scene.points, scene.poses, min_range_m=scene.min_range_m, max_range_m=scene.max_range_m)
    distance, _ = cKDTree(rays.points + rays.origin).query(lidar, distance_upper_bound=SEEN_BY_RADAR_M)
    seen: NDArray[np.float64] = lidar[distance <= SEEN_BY_RADAR_M]
    return seen


def _corners(box: ArrayLike) -> NDArray[np.float64]:
    corners: NDArray[Any] = np.asarray(box, np.float64)
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        msg = "box must be (2, 3): a lower corner and an upper one above it"
        raise ValueError(msg)
    return corners
