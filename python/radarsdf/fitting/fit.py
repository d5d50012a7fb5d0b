"""Entry point and steps of a fit, from scans to a map."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch

from radarsdf.arrays import ArrayLike, Bools, Floats32, Ints
from radarsdf.checks import AnyPath, instance, pose_matrices
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import cell_keys, stable_order
from radarsdf.field.field import Field, NeuralField
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.estimate import Schedule, check_extent, check_fit, skipped_parts
from radarsdf.fitting.surface_returns import SurfaceReturns, average_surface, occupied_cells
from radarsdf.fitting.train import Diverged, Interrupted, Training
from radarsdf.map.queries import Deferred, MapContents, evaluate
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, ReturnsOfCells, VisibilityCounts
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.moving import static_rays
from radarsdf.returns.noise import SensorNoise, sensor_noise, without_false_deviations
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.reflectance import Reflectance
from radarsdf.returns.sensor import Radars, Sensor
from radarsdf.returns.sums import ScanSums
from radarsdf.returns.view_statistics import FreeSpace, ViewStatistics
from radarsdf.scans import Scans, filled
from radarsdf.threads import ThreadPool, resolve_num_threads


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
        Doppler unless these are passed separately, and the deviations that the sensor states.
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
        rig, scans, poses_, intensities_, doppler_mps_, sigmas = filled(points, **others, sigmas=None)
        if rig is not None:
            poses_ = rig.sensor_poses(pose_matrices(poses_, len(rig.of_scan)))
        given = scans, poses_, intensities_, doppler_mps_, rig
        num_threads = resolve_num_threads(config.num_threads)
        rays, moving, why_none = static_rays(*given, config, sigmas, origin=origin, num_threads=num_threads)
        rays = without_false_deviations(rays, config.leaf_size_m, config.returns, num_threads)
        rays, radars = Radars.unify(rays, rig, config, num_threads)
        scale = IntensityScale.of(rays.intensities)
        if intensity_range is not None and scale is not None:
            scale = IntensityScale.between(intensity_range)
        return FitInput(rays, scale, poses_, moving, why_none, radars=radars)

    return fit_rays(read, config, progress=progress, checkpoint=checkpoint)


_Stop = KeyboardInterrupt | Diverged | None
# Of more returns than both of these for each radar, closed-form intensities use an even sample. Measured on a street of 10⁷
# returns: every second has an error larger by 0.1 % of the noise in half the time, every fourth 0.3 %, every seventh 0.4 %; on
# `facade` (500,000 returns) every second 1.4 % of the error. A rig of three in a `car_park`, the same: 0.3 to 1.7 %.
_ENOUGH_RETURNS, _ENOUGH_PER_PLANE = 200_000, 16


@dataclasses.dataclass(frozen=True)
class FitInput:
    """Input of a fit. Fields that are None are computed from the rays."""

    rays: Rays  # all rays, scan by scan
    scale: IntensityScale | None  # scale of their intensities
    poses: ArrayLike | None = None  # (F, 4, 4) T_world_sensor of the scans, used to estimate the `sensor`
    moving: int = 0  # number of moving returns left out
    why_none_moving: str | None = None  # why Doppler was not used, in words
    inside: Bools | None = None
    """(N,) mask of the returns to fit, in whole leaf cells. The other rays only mark free space. None: all."""
    whole: dict[str, Any] | None = None  # contents common to the tiles of a map
    box_cells: Ints | None = None
    """(2, 3) box [lower, upper) of free-space crossings to store, leaf cells from the origin. None: no limit."""
    sums: ScanSums | None = None  # sums over the scans of the rays, if updated incrementally
    radars: Radars | None = None  # of a rig. None: there is one, whose noise is estimated
    visibility: VisibilityCounts | None = None  # visibility counts, if updated incrementally


def fit_rays(
    read: Callable[[], FitInput],
    config: FitConfig,
    *,
    progress: bool | None = None,
    checkpoint: AnyPath | None = None,
) -> RadarMap:
    """Fit a map to the input that `read` returns. See :func:`radarsdf.fit`, also for errors."""
    try:
        # A map created in inference mode could not compute gradients later.
        with torch.inference_mode(mode=False), ThreadPool(config.num_threads) as pool:
            contents, stop = _Fit(config, progress, checkpoint, pool).run(read)
    except KeyboardInterrupt as interruption:
        raise Interrupted(None) from interruption
    radar_map = RadarMap(contents)
    if isinstance(stop, Diverged):
        stop.radar_map = radar_map
        raise stop
    if stop is not None:
        raise Interrupted(radar_map) from stop
    return radar_map


@dataclasses.dataclass(frozen=True)
class _Fit:
    config: FitConfig
    progress: bool | None
    checkpoint: AnyPath | None
    pool: ThreadPool
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)  # wall-clock time of each step
    _start_s: float = dataclasses.field(default_factory=time.perf_counter)

    def _lap(self, step: str) -> None:
        self.seconds[step] = time.perf_counter() - self._start_s - sum(self.seconds.values())

    def run(self, read: Callable[[], FitInput]) -> tuple[MapContents, _Stop]:
        """Return the contents of the map, and the reason for an early end of the training, if any."""
        contents, of_intensities, training, saved = self._begin(read)
        stop: _Stop = None
        if training is not None:
            if saved is not None:
                saved.resume(training)
            try:
                training.run(self.progress, saved)
            except (KeyboardInterrupt, Diverged) as early:
                stop = early
            contents.report.update(training.report())
            del training  # frees its state
        # The residuals of a diverged network are arbitrary.
        if of_intensities is not None and not (isinstance(stop, Diverged) and self.config.trains_intensity):
            contents.field.reflectance = closed_form(contents, *of_intensities, self.pool.num_threads)
        contents.field.requires_grad_(False)
        self._lap("training_s")
        contents.report.update(self.seconds)
        return contents, stop

    def _begin(
        self, read: Callable[[], FitInput]
    ) -> tuple[MapContents, tuple[Rays, Surfels] | None, Training | None, Checkpoint | None]:
        """Do all before the training, which copies its rays: what the map does not keep is freed at the end.

        Return the map before its training, the input of the closed form, and the training and its file, if any.
        """
        given, config, num_threads = read(), self.config, self.pool.num_threads
        check_extent(given.rays, config)
        check_fit(given.rays, config, given.inside)
        path = self.checkpoint
        saved = None if path is None else Checkpoint(path, given.rays, given.scale, config)
        self._lap("prepare_s")

        noise: SensorNoise | None = None if given.radars is None else given.radars.noise
        if noise is None and given.rays.stated is not None:  # the weights of the returns need it
            surfels = Surfels.of(given.rays, config.leaf_size_m, num_threads)
            noise = sensor_noise(surfels, given.rays, config.returns, num_threads)
        surface = SurfaceReturns.of(given.rays, config, num_threads, given.inside, given.sums, noise)
        learnt = given.rays if given.inside is None else given.rays.select(given.inside)
        self._lap("ghosts_s")

        leaf_keys, returns = occupied_cells(surface, config, num_threads)
        with_network = config.trains_intensity and learnt.intensities is not None
        field: Field
        if surface.means is None:
            field = NeuralField(leaf_keys, config, with_intensity=with_network, num_threads=num_threads)
            field.initialise(torch.Generator("cpu").manual_seed(config.seed))
        else:
            field = average_surface(leaf_keys, surface, returns, config, num_threads)
        self._lap("occupied_cells_s")

        labelled = [len(learnt.points[rows]) for rows in learnt.rows_of_sensors()] if with_network else []
        sizes = {"surface_returns": surface.count, "vertices": field.table.num_rows}
        schedule = Schedule.of(config, **sizes, labelled=labelled)
        contents = self._contents(given, learnt, surface, field, returns, schedule)
        closes = learnt.intensities is not None and config.closes_intensity
        training = None
        if isinstance(field, NeuralField):
            training = Training(field, surface.rays, learnt, given.scale, schedule, config, self.pool)
        self._lap("start_s")
        return contents, (learnt, surface.surfels) if closes else None, training, saved

    def _contents(
        self,
        given: FitInput,
        learnt: Rays,
        surface: SurfaceReturns,
        field: Field,
        returns: ReturnsOfCells,
        schedule: Schedule,
    ) -> MapContents:
        config, leaf_m, num_threads = self.config, self.config.leaf_size_m, self.pool.num_threads
        rays, scale, surfels = given.rays, given.scale, surface.surfels
        whole = given.whole
        if whole is None:
            assert given.poses is not None
            whole = {
                "clutter_ratio": surfels.clutter_ratio(),
                "returns_per_cell": surfels.returns_per_cell(),
                "sensor": Sensor.of_rays(rays, given.poses, surface.noise.mean),
                "sensors": {} if given.radars is None else given.radars.sensors(rays, given.poses),
            }
        keys, noise, true, box_cells = field.table.leaf_keys(), surface.noise, surface.true, given.box_cells

        def free_space() -> FreeSpace:
            of_true = rays if true is None else rays.select(true)
            return FreeSpace.of(of_true, noise, leaf_m, box_cells, num_threads)

        def view_statistics() -> ViewStatistics:
            known = learnt.with_intensity
            if scale is None or not known.any():
                return ViewStatistics.none()
            chosen = learnt if known.all() else learnt.select(known)
            assert chosen.intensities is not None
            return ViewStatistics.of(chosen, scale.to_unit(chosen.intensities), leaf_m)

        # Only grids, comparisons and files ask for these, which took a third of a fit. The map keeps the rays until then.
        deferred = config.returns.free_space
        return MapContents(
            field=field,
            config=config,
            report=_report(given, learnt, surface, field, schedule, config),
            origin=rays.origin,
            intensity_scale=scale,
            evidence=Evidence.of(returns, rays, keys, leaf_m, num_threads, given.visibility),
            free_space=Deferred(free_space) if deferred else FreeSpace.none,
            view_statistics=Deferred(view_statistics) if deferred else ViewStatistics.none,
            **whole,
        )


def _report(
    given: FitInput, rays: Rays, surface: SurfaceReturns, field: Field, schedule: Schedule, config: FitConfig
) -> dict[str, Any]:
    sizes = {"returns": len(rays), "cells": len(field.table.leaf_keys()), "rows": field.table.num_rows}
    skipped = skipped_parts(config, schedule, with_intensity=given.scale is not None, **sizes)
    if given.why_none_moving is not None:
        skipped.insert(0, (f"leaving out what moves: {given.why_none_moving}", None))
    outliers = 0 if rays.intensities is None else len(rays) - int(rays.with_intensity.sum())
    return {
        "scans": len(given.rays.up_of_scan),
        "returns": given.rays.num_given + given.moving,
        "returns_used": surface.count,
        "ghosts": len(rays) - surface.count,
        "moving": given.moving,
        "intensity_outliers": outliers,
        "noise": dataclasses.asdict(surface.noise.mean),
        **({} if given.radars is None else {"sensors": given.radars.report(given.rays)}),
        "leaf_cells": sizes["cells"],
        "vertices": sizes["rows"],
        "skipped": [words for words, _ in skipped],
        "skipped_s": [seconds for _, seconds in skipped],
        "iterations": schedule.iterations,
        "iterations_done": {"sdf": 0, "intensity": 0},
        "losses": {},
        "loss_history": {},
    }


def closed_form(contents: MapContents, rays: Rays, surfels: Surfels, num_threads: int) -> Reflectance:
    """Fit intensities of `rays`, ghosts included, in closed form, or the residuals of the network of a map."""
    field, config, scale = contents.field, contents.config, contents.intensity_scale
    assert scale is not None
    known = rays.with_intensity
    if known.any() and not known.all():  # a tile without any counts as the middle of the range
        rays = rays.select(known)
    rays = _in_order(rays, surfels, num_threads)
    assert rays.intensities is not None

    def network(points: Floats32, directions: Floats32, ranges_m: Floats32) -> Floats32:
        columns = np.column_stack([points, directions, np.clip(ranges_m, *contents.sensor.range_m)])
        return evaluate(lambda x: field.intensity(x[:, :3], x[:, 3:6], x[:, 6]), columns).clip(0, 1)

    unit = np.nan_to_num(scale.to_unit(rays.intensities), copy=False, nan=0.5)
    ask = network if config.trains_intensity else None
    return Reflectance.of(rays, unit, surfels, config.leaf_size_m, ask, num_threads)


def _in_order(rays: Rays, surfels: Surfels, num_threads: int) -> Rays:
    """Sort rays by place, independent of the order of scans. Of very many, select every n-th: evenly among places."""
    enough = rays.num_sensors * max(_ENOUGH_RETURNS, _ENOUGH_PER_PLANE * int(surfels.is_flat().sum()))
    every = -(-len(rays) // enough)
    # The lower half of the Morton keys, which repeats after 400 m or more, and pseudo-random numbers within each cell.
    keys = cell_keys(rays.points, surfels.cell_size_m, num_threads) << np.uint64(33)
    return rays.select(stable_order(keys | rays.hashes() >> np.uint64(31))[::every])
