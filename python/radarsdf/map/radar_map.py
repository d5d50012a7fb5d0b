# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The map that a fit gives: signed distance, gradient, intensity, mesh, and its file."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import real_array
from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.map import queries, storage
from radarsdf.map.contents import MapContents

if TYPE_CHECKING:
    import trimesh


class RadarMap:
    """A fitted map. Made by :func:`radarsdf.fit` or :func:`radarsdf.load`.

    Queries take world coordinates, m, as NumPy arrays or CPU tensors, and answer in kind and in the same precision.
    Positions are brought to the map's local frame in float64 before they become float32, so UTM coordinates are fine.
    Queries may run in many threads at once, and maps be pickled, for workers in other processes.
    """

    def __init__(self, contents: MapContents) -> None:
        self._contents = contents

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return f"RadarMap({kind}, {len(self.support)} cells, {self.nbytes / 1e6:.1f} MB)"

    def __reduce__(self) -> tuple[Callable[..., RadarMap], tuple[Any, ...]]:
        return _from_pickle, storage.to_pickle(self._contents)

    @property
    def origin(self) -> NDArray[np.float64]:
        """(3,) float64, world coordinates of the local frame's zero, m."""
        return self._contents.origin

    @property
    def config(self) -> FitConfig:
        """What the map was fitted with."""
        return self._contents.config

    @property
    def intensity_scale(self) -> IntensityScale | None:
        """Range of the training intensities, sensor units. None: the map was fitted without intensities."""
        return self._contents.intensity_scale

    @property
    def report(self) -> dict[str, Any]:
        """Counts, losses and seconds of the fit, and under `skipped` what the scene did not need."""
        return self._contents.report

    @property
    def support(self) -> NDArray[np.uint16]:
        """(C,) uint16, returns in and round each leaf cell, in the order of the cells' keys."""
        return self._contents.support

    @property
    def has_intensity(self) -> bool:
        """Whether intensities were given to the fit."""
        return self.intensity_scale is not None

    @property
    def nbytes(self) -> int:
        """Size of features and network weights, bytes: what the paper calls the map's size."""
        return sum(p.numel() * p.element_size() for p in self.field.parameters())

    @property
    def field(self) -> Field:
        """The learnt field in the local frame, for those who build on it."""
        return self._contents.field

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
        return answer(queries.signed_distance(self._contents, points))

    @overload
    def gradient(self, x: Tensor) -> Tensor: ...
    @overload
    def gradient(self, x: ArrayLike) -> NDArray[Any]: ...
    def gradient(self, x: Any) -> Any:
        """Gradient of :meth:`sdf` at x (N, 3), world, m: (N, 3), towards free space.

        Of about unit length where rays met the surface head on, longer where they grazed it.
        """
        points, answer = self._local(x)
        return answer(queries.gradient(self._contents, points))

    @overload
    def observed(self, x: Tensor) -> Tensor: ...
    @overload
    def observed(self, x: ArrayLike) -> NDArray[np.bool_]: ...
    def observed(self, x: Any) -> Any:
        """Whether the data supports a surface at x (N, 3), world, m: (N,) bool.

        It does in the leaf cells round a return, and in those of a small gap between two.
        """
        points, answer = self._local(x)
        return answer(queries.occupied(self._contents, points))

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
        """
        points, answer = self._local(x)
        return answer(queries.confidence(self._contents, points))

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
        if not self.has_intensity:
            msg = "this map was fitted without intensities"
            raise ValueError(msg)
        points, answer = self._local(x)
        sensors, _ = self._local(sensor_positions, rows=len(points))
        return answer(queries.intensity(self._contents, points, sensors))

    def mesh(
        self,
        voxel_size: float = 0.1,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        min_confidence: float = 0.0,
        min_support: float | None = None,
        min_component_triangles: int = 30,
        progress: bool | None = None,
    ) -> trimesh.Trimesh:
        """The surface as triangles: marching cubes on the zero level, only where the map is occupied.

        Parameters
        ----------
        voxel_size : float
            Edge of the marching cubes' cells, m.
        box : (2, 3) array_like, optional
            Lower and upper corner, world, m. Only voxels whose centres lie inside are meshed.
        viewpoint : (3,) array_like, optional
            Sensor position, world, m. The vertices then carry the intensity predicted for it, in sensor units, as
            ``mesh.vertex_attributes["intensity"]``, and colours from dark (low) to bright (high).
        min_confidence : float
            In [0, 1]. Triangles with a vertex of less :meth:`confidence` are left out, before small components are.
        min_support : float, optional
            Triangles with a vertex that fewer returns support than this share of the map's median are left out (3QFP: 0). A
            share, since what is much for a sparse sensor is little for a dense one. Default: 0.12, and 0.15 for a surface
            that is an average.
        min_component_triangles : int
            Components of fewer triangles are left out (3QFP: 300, which on sparse scans costs ten points of completion).
        progress : bool, optional
            Whether to show a progress bar. By default only on a terminal.

        Returns
        -------
        trimesh.Trimesh
            World frame, m. Triangles, and so vertex normals, face free space. Empty where there is no surface. The
            vertices carry :meth:`confidence` as ``mesh.vertex_attributes["confidence"]``. ``mesh.metadata`` counts the leaf
            cells, and those that were searched because the surface could lie in them.

        Raises
        ------
        ValueError
            For a voxel size, box, viewpoint or confidence out of range, or a viewpoint for a map without intensities.
        MemoryError
            If so many voxels take more than ``config.max_memory_bytes``, or than the system has.
        """
        from radarsdf.map.meshing import extract_mesh  # noqa: PLC0415 - trimesh, which only a mesh needs, is slow to import

        return extract_mesh(
            self._contents,
            voxel_size,
            box=box,
            viewpoint=viewpoint,
            min_confidence=min_confidence,
            min_support=min_support,
            min_component_triangles=min_component_triangles,
            progress=progress,
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the whole map to one safetensors file; :func:`radarsdf.load` reads it back to the same answers."""
        storage.save_contents(self._contents, path)

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

        def answer(result: Tensor) -> Any:
            if result.dtype != torch.bool:
                keep_double = dtype in (torch.float64, np.dtype(np.float64), None)
                result = result.double() if keep_double else result
            return result if is_tensor else result.numpy()

        return queries.to_local(self._contents, world), answer


def load(path: str | PathLike[str]) -> RadarMap:
    """Reads a map that :meth:`RadarMap.save` wrote. Nothing in the file is executed.

    Parameters
    ----------
    path : path-like
        A file written by this version.

    Returns
    -------
    RadarMap
        Gives the same bits as the map that was saved.

    Raises
    ------
    ValueError
        If the file is not a radarsdf map, is damaged, or comes from another version.
    OSError
        If it cannot be read.
    """
    return RadarMap(storage.load_contents(path))


def _from_pickle(data: bytes, description: dict[str, Any]) -> RadarMap:
    return RadarMap(storage.from_pickle(data, description))
