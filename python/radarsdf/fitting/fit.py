# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From scans with poses to a map: what is given to a fit, checked and made into rays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike

from numpy.typing import ArrayLike

from radarsdf.checks import MISSING_POSES, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.moving import StaticReturns
from radarsdf.returns.rays import prepare
from radarsdf.scans import Scans, filled


def fit(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
    origin: ArrayLike | None = None,
    intensity_range: tuple[float, float] | None = None,
) -> RadarMap:
    """Fit a signed distance field, and with intensities a reflectance map, to radar returns.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m. Of :class:`radarsdf.io.Scans`, their poses, intensities and
        Doppler are used where none are given here.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan. Only `Scans` can do without.
    intensities : iterable of F arrays, optional
        (N_i,) each, sensor units. Without them the map has no intensity network. Those that cannot belong to the others,
        such as -9999 in place of a measurement, are left out of the reflectance; the surface keeps their returns.
        ``report["intensity_outliers"]`` counts them.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each: speed of each return along its ray, m/s; NaN where it was not measured. With them, returns that
        move are left out; see ``config.returns.drop_moving``.
    config : FitConfig, optional
        Settings of the fit. ``FitConfig.paper()`` has the published ones.
    progress : bool, optional
        Whether to show a progress bar. By default only on a terminal.
    checkpoint : path-like, optional
        File for the state of the training. It is written every half minute, and when the training is
        interrupted or done. If it exists, a fit of the same scans with the same configuration and number of
        threads goes on from it, and ends with the same bits as one without a stop. It is not removed when the
        fit is done.
    origin : (3,) array_like, optional
        Origin of the map's local frame, world, m. By default the sensors' mean position, moved to the next corner of a
        block of ``config.lattice``: fits whose origins are such corners share their cells.
    intensity_range : (low, high), optional
        Intensities that become 0 and 1 for the network, sensor units; those beyond are moved to its ends, but for those that
        are left out. By default the lowest and the highest of the others.

    Returns
    -------
    RadarMap
        Its ``report`` has the times and counts of the fit. The same input and seed give the same bits, with any
        number of threads. Only where the gradients are PyTorch's (``networks.normals``) does the rounding depend on it.

    Raises
    ------
    ValueError
        If scans or poses are invalid (see :func:`radarsdf.returns.rays.prepare`), a return is too far away,
        the range of intensities is not ascending, or the `checkpoint` is damaged or from another fit.
    MemoryError
        If the memory by :func:`radarsdf.estimate` exceeds ``config.max_memory_bytes``, or what the system has
        left.
    Interrupted
        A KeyboardInterrupt, after Ctrl-C. Its ``radar_map`` is the map so far.
    Diverged
        A FloatingPointError, if a loss or a parameter is not finite, or a loss is worse than any answer of the
        right size. Its ``radar_map`` is the last good map.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=4)
    >>> radar_map = radarsdf.fit(scans.points, scans.poses)  # and scans.intensities, for radar_map.intensity(...)
    >>> mesh = radar_map.mesh()
    >>> distance_m = radar_map.sdf(mesh.vertices)  # and NaN where nothing was observed
    >>> bool(abs(distance_m).max() < 0.2)
    True
    """
    config = FitConfig() if config is None else instance(config, FitConfig, "config")

    def read() -> FitInput:
        scans, poses_, intensities_, doppler_mps_ = filled(
            points, poses=poses, intensities=intensities, doppler_mps=doppler_mps
        )
        if poses_ is None:
            raise ValueError(MISSING_POSES)
        static = StaticReturns.of(scans, intensities_, doppler_mps_, config.returns)
        rays = prepare(static.points, poses_, static.intensities, origin=origin, **config.preparation)
        scale = IntensityScale.of(rays.intensities)
        if intensity_range is not None and scale is not None:
            scale = IntensityScale.between(intensity_range)
        return FitInput(rays, scale, poses_, static.moving, static.why_none)

    return fit_rays(read, config, progress=progress, checkpoint=checkpoint)
