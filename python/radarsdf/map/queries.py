"""The contents of a map, shared by its file, queries and mesh, and their values at positions (N, 3), local frame, m."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from radarsdf.arrays import Array, Bools, Floats, Floats32
from radarsdf.checks import hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import CellBlocks
from radarsdf.field.field import Field
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.reflectance import RANGE_MARGIN
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import FreeSpace, ViewStatistics, ViewStatisticsAt
from radarsdf.rig import Label
from radarsdf.threads import ThreadPool, resolve_num_threads, start_vector_library

_Part = TypeVar("_Part")


class Deferred(Generic[_Part]):
    """A part computed by `make` on first use. Until then, the references of `make` stay in memory."""

    def __init__(self, make: Callable[[], _Part]) -> None:
        self._make: Callable[[], _Part] | None = make

    def __call__(self) -> _Part:
        if (make := self._make) is not None:
            self._part = make()
            self._make = None
        return self._part


@dataclasses.dataclass(frozen=True)
class WholeMap:
    """Properties of the whole map on which evidence at a place depends, besides the returns there."""

    origin: Floats  # (3,) origin of the local frame in world coordinates, m
    config: FitConfig
    clutter_ratio: float  # share of the returns not on a thin surface, in [0, 1]
    returns_per_cell: float  # mean number of returns in the cells of surfels with returns


@dataclasses.dataclass(frozen=True)
class MapContents(WholeMap):
    field: Field  # signed distance and intensity, in the local frame
    intensity_scale: IntensityScale | None  # range of the training intensities. None without intensities
    evidence: Evidence  # evidence of a surface in each leaf cell
    sensor: Sensor  # the radar, estimated from the scans of the fit
    report: dict[str, Any]  # counts, losses, sensor noise and times of the fit, s
    free_space: Callable[[], FreeSpace] = FreeSpace.none  # free-space crossings, or none
    view_statistics: Callable[[], ViewStatistics] = ViewStatistics.none  # of intensity, or none
    sensors: dict[Label, Sensor] = dataclasses.field(default_factory=dict)  # radars of a rig by label

    def views_in_world(self) -> ViewStatisticsAt:
        """Return the view statistics in the world frame, in sensor units."""
        scale = self.intensity_scale or IntensityScale(0.0, 1.0)
        return self.view_statistics().in_world(self.origin, scale.low, scale.high)

    @cached_property
    def evidence_of_cells(self) -> tuple[CellBlocks, Floats32]:
        """The leaf cells, and (C, 4) see :meth:`radarsdf.returns.evidence.Evidence.columns`. Prepared by the first query."""
        keys = self.field.table.leaf_keys()
        return CellBlocks(keys), self.evidence.columns(keys, resolve_num_threads(0))


INWARD = 1e-3
"""Shift of points on the border of a map into it, edges of a cell."""
_CHUNK = 1 << 13  # points per evaluation, so that hidden layers fit the second-level cache
_MIN_RANGE_M = 1e-6  # lower bound of the norm of a direction, for points at the sensor


def to_local(contents: WholeMap, world: Floats) -> Floats32:
    """Convert world positions (N, 3), m, to the local frame, float32. The origin is subtracted in float64."""
    with np.errstate(over="ignore"):  # beyond float32 is infinite
        return (world - contents.origin).astype(np.float32, order="C")


def signed_distance(
    contents: MapContents, points: Floats32, *, description: str = "", progress: bool | None = False
) -> Floats32:
    if contents.field.corner_distances_m() is not None:
        return np.ascontiguousarray(plane(contents, points)[:, 0])
    return evaluate(contents.field.sdf, points, description=description, progress=progress)


def plane(contents: MapContents, points: Floats32) -> Floats32:
    """Evaluate the signed distance and its gradient, (N, 4)."""
    field = contents.field
    if (stored_m := field.corner_distances_m()) is None:
        return evaluate(field.plane, points)
    return field.table.trilinear(stored_m, points, resolve_num_threads(0))  # without the overhead of PyTorch


def intensity(
    contents: MapContents, points: Floats32, sensors: Floats32, *, extrapolate: bool = False
) -> Floats32:
    """Predict intensities (N,), sensor units; NaN for ranges and elevations unlike those of all returns, unless `extrapolate`."""
    scale, field = contents.intensity_scale, contents.field
    assert scale is not None

    def of_chunk(chunk: Tensor) -> Tensor:
        positions, rays = chunk[:, :3], chunk[:, :3] - chunk[:, 3:]
        ranges_m = rays.norm(dim=1)
        directions = rays / ranges_m.clamp_min(_MIN_RANGE_M)[:, None]
        # Clip to the ranges of the fit: the regression would extrapolate.
        nearest_m, farthest_m = contents.sensor.range_m
        found = scale.to_sensor(field.intensity(positions, directions, ranges_m.clamp(nearest_m, farthest_m)))
        if extrapolate:
            return found
        measured = (ranges_m >= nearest_m / RANGE_MARGIN) & (ranges_m <= farthest_m * RANGE_MARGIN)
        if field.reflectance is not None:
            measured &= torch.from_numpy(field.reflectance.measured(directions.numpy(), ranges_m.numpy()))
        return found.where(measured, torch.nan)

    return evaluate(of_chunk, np.concatenate([points, sensors], axis=1))


@torch.inference_mode(mode=False)  # gradients, for normals, need ordinary tensors
def evaluate(
    f: Callable[[Tensor], Tensor], points: Floats32, *, description: str = "", progress: bool | None = False
) -> Array:
    """Evaluate f(points) without gradients, in chunks, on the number of threads of PyTorch."""
    rows = torch.from_numpy(points)
    if len(rows) <= _CHUNK:
        start_vector_library()  # the first queries may be concurrent
        with torch.no_grad():
            return f(rows).numpy()
    chunks = torch.split(rows, _CHUNK)
    with ThreadPool() as pool:
        results = pool.map(torch.no_grad()(f), chunks)
        bar = tqdm(results, description, len(chunks), unit="chunk", disable=hides_bar(progress))
        return torch.cat(list(bar)).numpy()


def into_cells(contents: MapContents, points: Floats32, size_m: float | None = None) -> Bools:
    """Shift points on the border of occupied leaf cells slightly into one, in place; return a mask of those inside.

    A point on a face, such as a vertex of a mesh, belongs to the cell above it, which may be empty.
    """
    step_m = INWARD * (contents.config.leaf_size_m if size_m is None else size_m)
    return contents.field.table.into_cells(points, step_m, resolve_num_threads(0))


def where(known: Bools, query: Callable[..., Array], contents: MapContents, *inputs: Floats32) -> Array:
    """Evaluate query(contents, *inputs) for the rows in the mask `known` (N,); NaN for the others."""
    if known.all():
        return query(contents, *inputs)
    found = query(contents, *(rows[known] for rows in inputs))
    result = np.full((len(known), *found.shape[1:]), np.nan, found.dtype)
    result[known] = found
    return result
