"""Entry point of fitting: checks the input and converts it to rays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from numpy.typing import ArrayLike

from radarsdf.checks import AnyPath, instance, pose_matrices
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.moving import StaticReturns
from radarsdf.returns.radars import Radars
from radarsdf.returns.rays import prepare
from radarsdf.scans import Scans, filled
from radarsdf.threads import resolve_num_threads


def fit(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
    checkpoint: AnyPath | None = None,
    origin: ArrayLike | None = None,
    intensity_range: tuple[float, float] | None = None,
) -> RadarMap:
    """Fit a signed distance field, and with intensities a reflectance map, to radar returns.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m. :class:`radarsdf.io.Scans` supply poses, intensities and
        Doppler unless these are passed separately.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan; of `Scans` with mountings, T_world_body. Required unless `points` are
        `Scans` with poses.
    intensities : iterable of F arrays, optional
        (N_i,) each, sensor units. Without them the map has no reflectance. Outliers, such as -9999 in place of a
        measurement, are excluded from the reflectance; the surface keeps their returns. ``report["intensity_outliers"]``
        counts them.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each: radial speed of each return, m/s; NaN where it was not measured. With Doppler, moving returns are
        left out; see ``config.returns.drop_moving``.
    config : FitConfig, optional
        Settings of the fit. ``FitConfig.paper()`` returns the published ones.
    progress : bool, optional
        Whether to show a progress bar. Default: only on a terminal.
    checkpoint : path-like, optional
        File for the state of the training, written every half minute, and when the training is interrupted or
        done. If it exists, a fit of the same scans with the same configuration and number of threads resumes
        from it, bit-identical to an uninterrupted fit. It is not removed at the end.
    origin : (3,) array_like, optional
        Origin of the map's local frame, world, m. Default: the mean sensor position, rounded to the nearest block corner
        of ``config.lattice``. Fits with origins at block corners share their cells.
    intensity_range : (low, high), optional
        Intensities scaled to 0 and 1, units of the first radar; others are clipped, except for outliers, which are left out. Default: the
        range of the intensities without outliers.

    Returns
    -------
    RadarMap
        Its ``report`` has the times and counts of the fit. Results are bit-identical for the same input and seed, with any
        number of threads. Only with the gradients of PyTorch (``networks.normals``) does rounding depend on that number.

    Raises
    ------
    ValueError
        If scans or poses are invalid (see :func:`radarsdf.returns.rays.prepare`), a return is too far away,
        the range of intensities is not ascending, or the `checkpoint` is damaged or from another fit.
    MemoryError
        If the memory estimated by :func:`radarsdf.estimate` exceeds ``config.max_memory_bytes``, or what the
        system has left.
    Interrupted
        After Ctrl-C, a KeyboardInterrupt. Its ``radar_map`` is the map so far.
    Diverged
        If a loss or a parameter is not finite, or a loss exceeds the worst plausible prediction; a
        FloatingPointError. Its ``radar_map`` is the last good map.

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
        others = {"poses": poses, "intensities": intensities, "doppler_mps": doppler_mps}
        rig, scans, poses_, intensities_, doppler_mps_ = filled(points, **others)
        if rig is not None:
            poses_ = rig.sensor_poses(pose_matrices(poses_, len(rig.of_scan)))
        static = StaticReturns.of(scans, intensities_, doppler_mps_, config.returns, rig)
        options = config.preparation | {"num_threads": resolve_num_threads(config.num_threads)}
        rays = prepare(static.points, poses_, static.intensities, origin=origin, rig=rig, **options)
        radars = None
        if rig is not None:
            radars = Radars.of(rays, rig.labels, config, options["num_threads"])
            rays = radars.in_one_unit(rays)
        scale = IntensityScale.of(rays.intensities)
        if intensity_range is not None and scale is not None:
            scale = IntensityScale.between(intensity_range)
        return FitInput(rays, scale, poses_, static.moving, static.why_none, radars=radars)

    return fit_rays(read, config, progress=progress, checkpoint=checkpoint)
