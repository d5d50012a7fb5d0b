# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensity against held-out frames, and the nearest-neighbour baseline to be beaten."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from radarsdf.checks import MAX_POSITION_M, positive, real_array, whole_number

INTENSITY_PROTOCOL = "radarsdf-intensity-1"
"""Name and version of the definitions in `intensity_metrics`; a change of any number's meaning changes it."""

_MAX_FRAMES = 10**8  # 58 days at 20 Hz; a larger number is a mistake, and would fill the memory
_MAX_INTENSITY = 1e100  # the sum of as many as memory holds is finite
_CHUNK = 1 << 17  # queries at a time: 20 candidates of each take about 150 MB


class IntensityMetrics(TypedDict):
    """Result of `intensity_metrics`."""

    protocol: str
    mae: float
    medae: float
    num_returns: int


def intensity_metrics(predicted: ArrayLike, measured: ArrayLike) -> IntensityMetrics:
    """Compare predicted with measured intensities.

    Parameters
    ----------
    predicted, measured
        (N,) intensities in the sensor's own units.

    Returns
    -------
    IntensityMetrics
        `mae` and `medae`, mean and median absolute error in the sensor's units, and `num_returns`.

    Raises
    ------
    ValueError
        If the shapes differ, there is no return, or a value is not finite: a return without a prediction
        has to be given one, since leaving it out would flatter the method.
    """
    p, m = real_array(predicted, "predicted"), real_array(measured, "measured")
    if p.ndim != 1 or p.shape != m.shape:
        msg = f"predicted {p.shape} and measured {m.shape} must both be (N,)"
        raise ValueError(msg)
    if p.size == 0:
        msg = "no returns to compare"
        raise ValueError(msg)
    if not ((np.abs(p) <= _MAX_INTENSITY).all() and (np.abs(m) <= _MAX_INTENSITY).all()):
        msg = f"predicted and measured must be finite, and within {_MAX_INTENSITY:g}"
        raise ValueError(msg)
    error = np.abs(p - m)
    return IntensityMetrics(
        protocol=INTENSITY_PROTOCOL,
        mae=float(error.mean()),
        medae=float(np.median(error)),
        num_returns=p.size,
    )


def holdout(frames: int | Iterable[int], every: int = 10) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split frames into those to train on and those held out.

    The first frame is held out and then every `every`-th: 0, 10, 20, … of the frames in ascending order. The
    paper holds out every tenth point cloud and leaves open with which one it begins.

    Parameters
    ----------
    frames
        Number of frames F, standing for frames 0 … F-1; or frame numbers, one per frame or one per return,
        in any order and with repetitions.
    every
        Distance between held-out frames, at least 2.

    Returns
    -------
    train, test : (A,), (B,) int64
        Frame numbers, ascending. Select returns with ``numpy.isin(frame, test)``.

    Raises
    ------
    ValueError
        If `every` is below 2 or there are fewer than two frames, which would leave nothing to train on.

    Examples
    --------
    >>> train, test = holdout(7, every=3)
    >>> train.tolist(), test.tolist()
    ([1, 2, 4, 5], [0, 3, 6])
    """
    whole_number(every, "every", -(2**63))
    if isinstance(frames, (int, np.integer)):
        numbers = np.arange(whole_number(frames, "frames", 0, _MAX_FRAMES))
    else:
        numbers = np.unique(np.asarray(frames))
    if numbers.ndim != 1 or not (numbers.size == 0 or np.issubdtype(numbers.dtype, np.integer)):
        msg = "frames must be a number of frames or integer frame numbers"
        raise ValueError(msg)
    if numbers.size and numbers[-1] > np.iinfo(np.int64).max:
        msg = "frame numbers must fit int64"
        raise ValueError(msg)
    if every < 2 or numbers.size < 2:
        msg = f"cannot hold out every {every}th of {numbers.size} frames: something must remain to train on"
        raise ValueError(msg)
    held_out = np.arange(numbers.size) % every == 0
    return numbers[~held_out].astype(np.int64), numbers[held_out].astype(np.int64)


class KNNIntensity:
    """Intensity from the nearest returns seen from a similar direction: the paper's baseline.

    Of the `candidates` returns nearest in space, the `k` whose viewing direction differs least are averaged with
    weights 1 / ((distance + distance_scale_m) · (angle + angle_scale_rad)).

    Parameters
    ----------
    points_world
        (N, 3) returns of the training frames, world frame, metres.
    sensor_positions
        (N, 3) or (3,) sensor origin of each return, world frame, metres.
    intensities
        (N,) in the sensor's own units.
    candidates, k
        Sizes of the two selections, 1 ≤ k ≤ candidates.
    distance_scale_m, angle_scale_rad
        Below these a smaller distance or angle is no evidence of more likeness (noise of the returns), and no
        single neighbour takes all the weight.
    num_threads
        Threads of the spatial search; below 1 means all.

    Notes
    -----
    The paper names neither numbers nor weights. The defaults were chosen on the held-out frames of four scenes
    of an automotive radar, so that the baseline is as strong as it can fairly be. There an average over many
    counts more than likeness of view, as intensity fluctuates from frame to frame: 4 of 128 candidates were a
    tenth worse, 16 of 16 one percent better (the angle then only weighs). Where the view decides, as with a
    corner reflector, more candidates help.
    """

    def __init__(
        self,
        points_world: ArrayLike,
        sensor_positions: ArrayLike,
        intensities: ArrayLike,
        *,
        candidates: int = 20,
        k: int = 16,
        distance_scale_m: float = 0.1,
        angle_scale_rad: float = 0.1,
        num_threads: int = -1,
    ) -> None:
        points, directions = _rays(points_world, sensor_positions)
        values = real_array(intensities, "intensities")
        if len(points) == 0:
            msg = "a baseline needs at least one return"
            raise ValueError(msg)
        if values.shape != (len(points),) or not (np.abs(values) <= _MAX_INTENSITY).all():
            msg = f"intensities must be ({len(points)},) and finite, but have shape {values.shape}"
            raise ValueError(msg)
        whole_number(k, "k", 1)
        whole_number(candidates, "candidates", 1)
        if not k <= candidates:
            msg = f"1 <= k <= candidates is needed, not k={k}, candidates={candidates}"
            raise ValueError(msg)
        positive(distance_scale_m, "distance_scale_m")
        positive(angle_scale_rad, "angle_scale_rad")
        self._directions, self._values = directions, values
        self._origin = points.mean(axis=0)
        self._tree = cKDTree(points - self._origin)
        self._candidates = min(candidates, len(points))
        self._k = min(k, len(points))
        self._scales = distance_scale_m, angle_scale_rad
        self._workers = num_threads if num_threads > 0 else -1

    def predict(self, x: ArrayLike, sensor_positions: ArrayLike) -> NDArray[np.float64]:
        """Predict the intensity of returns.

        Parameters
        ----------
        x
            (M, 3) points, world frame, metres.
        sensor_positions
            (M, 3) or (3,) where each is seen from, world frame, metres.

        Returns
        -------
        (M,) float64
            Intensity in the sensor's own units. Defined everywhere: far from all returns it is that of the
            nearest ones.
        """
        points, directions = _rays(x, sensor_positions)
        predicted = np.zeros(len(points))
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            predicted[part] = self._predict(points[part] - self._origin, directions[part])
        return predicted

    def _predict(self, points: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        ranks = np.arange(1, self._candidates + 1)  # a list, so that one candidate still gives two dimensions
        distance, index = self._tree.query(points, k=ranks, workers=self._workers)
        chord = np.linalg.norm(self._directions[index] - directions[:, None], axis=2)
        angle = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))  # accurate at small angles, unlike arccos
        if self._k < self._candidates:
            closest = np.argpartition(angle, self._k - 1, axis=1)[:, : self._k]
            distance, index, angle = (
                np.take_along_axis(a, closest, axis=1) for a in (distance, index, angle)
            )
        weight = 1.0 / ((distance + self._scales[0]) * (angle + self._scales[1]))
        total = (weight * self._values[index]).sum(axis=1)
        return np.asarray(total / weight.sum(axis=1), dtype=np.float64)


def _rays(points: ArrayLike, sensors: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check points and sensor positions; return the points and unit vectors from the sensor to them."""
    x, s = real_array(points, "points"), real_array(sensors, "sensor positions")
    if x.ndim != 2 or x.shape[1] != 3 or s.shape not in {x.shape, (3,)}:
        msg = f"points must be (N, 3) and sensor positions (N, 3) or (3,), not {x.shape} and {s.shape}"
        raise ValueError(msg)
    if not ((np.abs(x) <= MAX_POSITION_M).all() and (np.abs(s) <= MAX_POSITION_M).all()):
        msg = f"points and sensor positions must be finite, and within {MAX_POSITION_M:g} m"
        raise ValueError(msg)
    ray = x - s
    length = np.linalg.norm(ray, axis=1, keepdims=True)
    if (length == 0).any():
        msg = "points and sensor positions must differ: each point needs a viewing direction"
        raise ValueError(msg)
    return x, ray / length
