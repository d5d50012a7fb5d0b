# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The map that a fit gives: signed distance, gradient, intensity, mesh, and its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from tqdm import tqdm

from radarsdf._core import CellBlocks
from radarsdf.checks import real_array
from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.threads import Workers, resolve_num_threads

if TYPE_CHECKING:
    import trimesh

_HALF_SUPPORT = 10.0  # returns round a cell that are worth a confidence of one half
MAX_CELLS_FROM_ORIGIN = 1_000_000  # along each axis: keys of cells have 21 bits for each
_CHUNK = 1 << 13  # points evaluated at a time: hidden layers stay in the second-level cache


@dataclass(frozen=True)
class IntensityScale:
    """Between the sensor's units and the [0, 1] of the intensity network: the training data's range."""

    low: float
    high: float

    @classmethod
    def of(cls, intensities: NDArray[np.float32] | None) -> IntensityScale | None:
        return None if intensities is None else cls(float(intensities.min()), float(intensities.max()))

    def to_unit(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        return ((intensities - np.float32(self.low)) / np.float32(self.high - self.low)).astype(np.float32)

    def to_sensor(self, unit: Tensor) -> Tensor:
        return self.low + (self.high - self.low) * unit


class RadarMap:
    """A fitted map. Made by :func:`radarsdf.fit` or :func:`radarsdf.load`.

    Queries take world coordinates, m, as NumPy arrays or CPU tensors, and answer in kind and in the same precision.
    Positions are brought to the map's local frame in float64 before they become float32, so UTM coordinates are fine.
    Queries may run in many threads at once, and maps be pickled, for workers in other processes.

    Attributes
    ----------
    origin : ndarray
        (3,) float64, world coordinates of the local frame's zero, m.
    config : FitConfig
        What it was fitted with.
    intensity_scale : IntensityScale or None
        Range of the training intensities, sensor units; None without a reflectance side.
    report : dict
        Counts, losses and seconds of the fit, and under `skipped` what the scene did not need.
    support : ndarray or None
        (C,) uint16, returns in and round each leaf cell, in the order of the cells' keys; None for a map from a file of
        an earlier version.
    """

    def __init__(
        self,
        *,
        field: Field,
        origin: NDArray[np.float64],
        intensity_scale: IntensityScale | None,
        config: FitConfig,
        report: dict[str, Any],
        support: NDArray[np.uint16] | None = None,
    ) -> None:
        self.origin = origin
        self.config = config
        self.intensity_scale = intensity_scale
        self.report = report
        self.support = support
        self._field = field

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return (
            f"RadarMap({kind}, {len(self._field.cells.table.leaf_keys())} cells, {self.nbytes / 1e6:.1f} MB)"
        )

    def __reduce__(self) -> tuple[Callable[..., RadarMap], tuple[Any, ...]]:
        from safetensors.torch import save as to_bytes  # noqa: PLC0415

        from radarsdf.map.storage import from_pickle, parts_of  # noqa: PLC0415 - storage is built on the map

        tensors, description = parts_of(self)
        return from_pickle, (to_bytes(tensors), description)

    @property
    def has_intensity(self) -> bool:
        """Whether intensities were given to the fit."""
        return self.intensity_scale is not None

    @property
    def nbytes(self) -> int:
        """Size of features and network weights, bytes: what the paper calls the map's size."""
        return sum(p.numel() * p.element_size() for p in self._field.parameters())

    @property
    def least_confidence(self) -> float:
        """What the mesh leaves out: ``config.min_support`` of the median support, as a confidence."""
        if self.support is None or not self.support.any():
            return 0.0
        returns = self.config.min_support * float(np.median(self.support[self.support > 0]))
        return returns / (returns + _HALF_SUPPORT)

    @property
    def field(self) -> Field:
        """The learnt field in the local frame, for those who build on it."""
        return self._field

    @overload
    def sdf(self, x: Tensor) -> Tensor: ...
    @overload
    def sdf(self, x: ArrayLike) -> NDArray[Any]: ...
    def sdf(self, x: Any) -> Any:
        """Signed distance to the surface.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.

        Returns
        -------
        (N,) array or tensor
            m, positive in free space. Meaningful near the surface (a few sigma); see :meth:`observed`. Zero on the
            surface; beside it the distance along the sensor's rays, which where they graze it is longer than the
            shortest.

        Raises
        ------
        ValueError
            If `x` does not have shape (N, 3).
        """
        points, answer = self._local(x)
        return answer(evaluate(self.local_sdf, points))

    @overload
    def gradient(self, x: Tensor) -> Tensor: ...
    @overload
    def gradient(self, x: ArrayLike) -> NDArray[Any]: ...
    def gradient(self, x: Any) -> Any:
        """Gradient of :meth:`sdf` at x (N, 3), world, m: (N, 3), towards free space.

        Of about unit length where rays met the surface head on, longer where they grazed it.
        """
        points, answer = self._local(x)

        def gradient(chunk: Tensor) -> Tensor:
            with torch.enable_grad():
                chunk = chunk.detach().requires_grad_()
                return torch.autograd.grad(self.local_sdf(chunk).sum(), chunk)[0]

        return answer(evaluate(gradient, points))

    @overload
    def observed(self, x: Tensor) -> Tensor: ...
    @overload
    def observed(self, x: ArrayLike) -> NDArray[np.bool_]: ...
    def observed(self, x: Any) -> Any:
        """Whether the data supports a surface at x (N, 3), world, m: (N,) bool.

        It does in the leaf cells round a return, and in those of a small gap between two.
        """
        points, answer = self._local(x)
        return answer(evaluate(self._field.cells.occupied, points))

    @overload
    def confidence(self, x: Tensor) -> Tensor: ...
    @overload
    def confidence(self, x: ArrayLike) -> NDArray[Any]: ...
    def confidence(self, x: Any) -> Any:
        """How well the data supports a surface at points.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.

        Returns
        -------
        (N,) array or tensor
            n / (n + 10) for n returns in the 27 leaf cells round the point, interpolated, without those that the fit
            dropped as ghosts: 0 where there are none, 0.5 at ten, towards 1 with more. It orders places by how far off
            the surface is likely to be; it is no probability.

        Raises
        ------
        ValueError
            If the map comes from a file of a version that did not store it.
        """
        if self.support is None:
            msg = "this map was saved by an earlier version, without confidence: fit it again"
            raise ValueError(msg)
        points, answer = self._local(x)
        # Trilinear between the centres of cells: a vertex on a cell's face is of both sides.
        table = self._field.cells.table
        support = self.support.astype(np.float32)
        # What is too far away for a key has no cell.
        limit_m = MAX_CELLS_FROM_ORIGIN * table.leaf_size_m
        near = points.nan_to_num(nan=limit_m).clamp(-limit_m, limit_m).contiguous()
        cells = CellBlocks(table.leaf_keys())
        returns = torch.from_numpy(
            cells.interpolate(table.leaf_size_m, support, near.numpy(), resolve_num_threads(0))
        )
        return answer(returns / (returns + _HALF_SUPPORT))

    @overload
    def intensity(self, x: Tensor, sensor_positions: Tensor) -> Tensor: ...
    @overload
    def intensity(self, x: ArrayLike, sensor_positions: ArrayLike) -> NDArray[Any]: ...
    def intensity(self, x: Any, sensor_positions: Any) -> Any:
        """Predicted intensity of the returns that sensors would get from points.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.
        sensor_positions : (N, 3) or (3,) array or tensor
            World, m.

        Returns
        -------
        (N,) array or tensor
            In the units of the intensities that the map was fitted to.

        Raises
        ------
        ValueError
            If the map has no intensities, or for wrong shapes.
        """
        scale = self.intensity_scale
        if scale is None:
            msg = "this map was fitted without intensities"
            raise ValueError(msg)
        points, answer = self._local(x)
        sensors, _ = self._local(sensor_positions, rows=len(points))

        def intensity(chunk: Tensor) -> Tensor:
            positions, rays = chunk[:, :3], chunk[:, :3] - chunk[:, 3:]
            ranges_m = rays.norm(dim=1)
            directions = rays / ranges_m.clamp_min(1e-6)[:, None]
            geometry = self._field.geometry(positions)
            return scale.to_sensor(self._field.reflectance(geometry, directions, ranges_m))

        return answer(evaluate(intensity, torch.cat([points, sensors], 1)))

    def mesh(
        self,
        voxel_size: float = 0.1,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        min_confidence: float = 0.0,
        progress: bool | None = None,
    ) -> trimesh.Trimesh:
        """The surface as triangles; see :func:`radarsdf.map.meshing.extract_mesh`."""
        from radarsdf.map.meshing import extract_mesh  # noqa: PLC0415 - meshing is built on the map

        return extract_mesh(
            self,
            voxel_size,
            box=box,
            viewpoint=viewpoint,
            min_confidence=min_confidence,
            progress=progress,
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the whole map to one safetensors file; :func:`radarsdf.load` reads it back to the same answers."""
        from radarsdf.map.storage import save_map  # noqa: PLC0415 - storage is built on the map

        save_map(self, path)

    def local_sdf(self, points: Tensor) -> Tensor:
        """Signed distance (N,), m, at points of the local frame (N, 3) float32."""
        return self._field.logit(points) * self._field.sigma_m

    def _local(self, x: Any, rows: int | None = None) -> tuple[Tensor, Callable[[Tensor], Any]]:
        """`x` in the local frame as float32 (N, 3), and what gives an answer the kind and precision of `x`.

        A single position (3,) is repeated `rows` times where those are given.
        """
        is_tensor = isinstance(x, Tensor)
        # Writable, or PyTorch warns: a read-only array is copied.
        world = (
            x.detach()
            if is_tensor
            else torch.from_numpy(np.require(real_array(x, "positions"), requirements=["C", "W"]))
        )
        dtype = x.dtype if is_tensor else getattr(x, "dtype", None)
        if rows is not None and world.shape == (3,):
            world = world.expand(rows, 3)
        if world.is_complex():
            msg = "positions must be real numbers"
            raise TypeError(msg)
        if world.ndim != 2 or world.shape[1] != 3 or (rows is not None and len(world) != rows):
            msg = f"positions must have shape (N, 3), not {tuple(world.shape)}"
            raise ValueError(msg)
        local = (world.double() - torch.from_numpy(self.origin)).float()

        def answer(result: Tensor) -> Any:
            if result.dtype != torch.bool:
                keep_double = dtype in (torch.float64, np.dtype(np.float64), None)
                result = result.double() if keep_double else result
            return result if is_tensor else result.numpy()

        return local, answer


def evaluate(
    function: Callable[[Tensor], Tensor],
    points: Tensor,
    *,
    description: str = "",
    progress: bool | None = False,
) -> Tensor:
    """function(points), without gradients, in chunks on all threads; with a progress bar where asked for."""

    def without_gradients(chunk: Tensor) -> Tensor:
        with torch.no_grad():
            return function(chunk)

    chunks = torch.split(points, _CHUNK) if len(points) > _CHUNK else (points,)
    if len(chunks) == 1:
        return without_gradients(points)
    with Workers() as workers:
        results = workers.map(without_gradients, chunks)
        disable = None if progress is None else not progress
        return torch.cat(list(tqdm(results, description, len(chunks), unit="chunk", disable=disable)))
