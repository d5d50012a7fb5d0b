# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What every map answers, whatever it is made of."""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import check_pose, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.map import queries
from radarsdf.map.parts import MapParts
from radarsdf.map.positions import as_positions
from radarsdf.returns.sensor import Sensor

if TYPE_CHECKING:
    import trimesh

    from radarsdf.grids.grid import Grid
    from radarsdf.map.views import View


GRID_VOXEL_M = 0.2
# More likely than not; and passed seven times as often as what is behind a surface.
OCCUPIED_FROM, FREE_TO = 0.5, 0.125


class Map(MapParts):
    """A surface and its reflectance: what :class:`RadarMap` and :class:`TiledMap` have in common.

    Queries take world coordinates, m, as NumPy arrays or CPU tensors. Results are of the same kind: float64
    for float64 coordinates and lists, otherwise float32. Coordinates are converted to the local frame in
    float64, so large ones such as UTM lose no precision. Positions of another shape than (N, 3) are a ValueError. Several
    threads may query a map at once. A map can be pickled for other processes.

    A map knows the cells near returns, see :meth:`observed`. Elsewhere, in free space too, and at positions that are
    not finite, the signed distance, gradient and intensity are NaN. Where there are no returns round a position, the
    uncertainty is NaN and the confidence 0.
    """

    @overload
    def sdf(self, x: Tensor, *, extrapolate: bool = False) -> Tensor: ...
    @overload
    def sdf(self, x: ArrayLike, *, extrapolate: bool = False) -> NDArray[Any]: ...
    def sdf(self, x: Any, *, extrapolate: bool = False) -> Any:
        """Signed distance to the surface.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.
        extrapolate : bool
            Whether to answer where nothing was observed, too: with what the field happens to be there. Neither its
            sign nor its size means anything then.

        Returns
        -------
        (N,) array or tensor
            Signed distance, m, positive in free space and zero on the surface. NaN where `x` is not :meth:`observed`, or not
            finite: free space far from surfaces is not told from the unknown. It is learnt along the sensor's rays. So it is
            longer than the shortest distance where rays meet the surface at a flat angle.
        """
        world, answer = as_positions(x)
        return answer(self._sdf(world, extrapolate))

    @overload
    def gradient(self, x: Tensor, *, extrapolate: bool = False) -> Tensor: ...
    @overload
    def gradient(self, x: ArrayLike, *, extrapolate: bool = False) -> NDArray[Any]: ...
    def gradient(self, x: Any, *, extrapolate: bool = False) -> Any:
        """Gradient of :meth:`sdf` at x (N, 3), world, m: (N, 3), towards free space.

        Its length is about 1 where rays met the surface at a right angle, and more where they met it at a
        flat angle. It is NaN where :meth:`sdf` is, and `extrapolate` does the same.
        """
        world, answer = as_positions(x)
        return answer(self._gradient(world, extrapolate))

    @overload
    def observed(self, x: Tensor) -> Tensor: ...
    @overload
    def observed(self, x: ArrayLike) -> NDArray[np.bool_]: ...
    def observed(self, x: Any) -> Any:
        """Whether x (N, 3), world, m, is in a leaf cell of the map, or on its border: (N,) bool.

        These are the cells near returns, and those that bridge a small gap between two of them. Where it is False,
        :meth:`sdf`, :meth:`gradient` and :meth:`intensity` are NaN. A position that is not finite was not observed.
        """
        world, answer = as_positions(x)
        return answer(self._observed(world))

    @overload
    def uncertainty(self, x: Tensor) -> Tensor: ...
    @overload
    def uncertainty(self, x: ArrayLike) -> NDArray[Any]: ...
    def uncertainty(self, x: Any) -> Any:
        """Standard error of the surface's position at points, from the noise of the returns round them.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.

        Returns
        -------
        (N,) array or tensor
            (Σ 1 / σ²)^-½ over the returns in the 27 leaf cells round the point, interpolated between cells, and a floor that
            no number of returns makes smaller, added in quadrature; m. The noise σ of a return is that along the beam and
            across it together; see ``report["noise"]``. It grows with the range, so that far returns tell less than near
            ones. The floor is 0.05 leaf cells, and up to 1.1 more where much of the returns lies on no thin surface
            (:attr:`rough_share`). NaN where there are no returns in the cells round `x`, and where it is not finite. Errors
            of the poses count if ``returns.pose_sigma_m`` and ``pose_sigma_rad`` in the :class:`FitConfig` state them.
        """
        world, answer = as_positions(x)
        return answer(self._uncertainty(world))

    @overload
    def confidence(self, x: Tensor) -> Tensor: ...
    @overload
    def confidence(self, x: ArrayLike) -> NDArray[Any]: ...
    def confidence(self, x: Any) -> Any:
        """Probability that there is a surface at points, from the returns round them and the scans that looked there.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.

        Returns
        -------
        (N,) array or tensor
            Probability that a true surface is within the edge of a leaf cell, in [0, 1]. 0 where there are no
            returns in the cells round `x`, and where it is not finite. It is a logistic function of how precisely the returns agree (:meth:`uncertainty` without its floor), of
            how many returns a surface would have more, given the scans that looked there, in deviations of chance, and of
            the share of the map's returns that lie on no thin surface, and of how many returns lie together; at most the
            share of a normal distribution of the error of a surface that bends little within a leaf cell's edge. It was
            fitted to simulated places of twelve kinds and to five real drives, whole, of every sixth scan, and of their
            beginning. Measured on kinds that had no part in it, the worst tenth is mostly within 0.1 to 0.3 of the share
            of true surface.
        """
        world, answer = as_positions(x)
        return answer(self._confidence(world))

    @overload
    def intensity(self, x: Tensor, sensor_positions: Tensor, *, extrapolate: bool = False) -> Tensor: ...
    @overload
    def intensity(
        self, x: ArrayLike, sensor_positions: ArrayLike, *, extrapolate: bool = False
    ) -> NDArray[Any]: ...
    def intensity(self, x: Any, sensor_positions: Any, *, extrapolate: bool = False) -> Any:
        """Predicts the intensity of the return that a sensor gets from each point.

        From closer or farther than the returns of the fit, it is that at the end of their ranges.

        Parameters
        ----------
        x : (N, 3) array or tensor
            World, m.
        sensor_positions : (N, 3) or (3,) array or tensor
            World, m.
        extrapolate : bool
            Whether to answer where nothing was observed, too. It serves to compare with all returns of a scan that the
            map has not seen, of which some are where it knows nothing.

        Returns
        -------
        (N,) array or tensor
            Intensity, sensor units, as given to the fit. NaN where `x` is not :meth:`observed`, and where a position is
            not finite.

        Raises
        ------
        ValueError
            If the map has no intensities, or for wrong shapes.
        """
        if not self.has_intensity:
            msg = "this map was fitted without intensities"
            raise ValueError(msg)
        world, answer = as_positions(x)
        sensors, _ = as_positions(sensor_positions, rows=len(world))
        return answer(self._intensity(world, sensors, extrapolate))

    def mesh(
        self,
        voxel_size: float = queries.VOXEL_M,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        min_confidence: float | None = None,
        max_uncertainty: float | None = None,
        min_component_triangles: int | None = None,
        progress: bool | None = None,
    ) -> trimesh.Trimesh:
        """Extracts the surface as triangles, by marching cubes in the leaf cells of the map.

        Parameters
        ----------
        voxel_size : float
            Edge of a voxel, m.
        box : (2, 3) array_like, optional
            Lower and upper corner, world, m. Only voxels with their centre inside are meshed.
        viewpoint : (3,) array_like, optional
            Sensor position, world, m. The vertices then carry the intensity predicted for it, in sensor
            units, as ``mesh.vertex_attributes["intensity"]``, and colours from dark (low) to bright (high).
        min_confidence : float, optional
            In [0, 1]. Triangles with a vertex of less :meth:`confidence` are left out. Default: that at which the F-score
            of the observed surface is expected to be highest. Precision is the mean confidence of what is kept. What can
            be covered is less than all: some of it was hit by chance by no scan, and of some the position is too
            uncertain. The less that is, the more is kept. 0: all is kept (3QFP).
        max_uncertainty : float, optional
            Triangles with a vertex of more :meth:`uncertainty`, m, or of none, are left out. Default: there is no limit;
            what is uncertain is improbable, too.
        min_component_triangles : int, optional
            Components of fewer triangles are then left out. Default: 30 in voxels of up to 0.1 m, and fewer in larger
            ones, 15 at 0.2 m (3QFP: 300, which on sparse scans costs ten points of completion).
        progress : bool, optional
            Whether to show a progress bar. By default only on a terminal.

        Returns
        -------
        trimesh.Trimesh
            World frame, m. Triangles and vertex normals face free space. The mesh is empty if there is no surface. The
            vertices have their :meth:`confidence` as ``mesh.vertex_attributes["confidence"]``, and their :meth:`uncertainty`
            as ``"uncertainty_m"``. In ``mesh.metadata``, `leaf_cells` is the number of leaf cells, and `leaf_cells_searched`
            of those in which the surface can be; `min_confidence` is what was kept from, `expected_precision` the share of
            it that is expected to be true, `coverage_of_observed` the share of the surface that returns lie on that it is
            expected to cover, and `whole_precision` and `whole_coverage_of_observed` are those if all were kept. What no ray
            reached is not in them: of all that is there, the mesh may cover far less.

        Raises
        ------
        ValueError
            If an argument is out of range, or there is a viewpoint but the map has no intensities.
        MemoryError
            If the voxels need more memory than ``config.max_memory_bytes``, or than the system has left.
        """
        return self._mesh_seen_from(
            viewpoint,
            voxel_size,
            box=box,
            min_confidence=min_confidence,
            max_uncertainty=max_uncertainty,
            min_component_triangles=min_component_triangles,
            progress=progress,
        )

    def _mesh_seen_from(
        self, viewpoint: ArrayLike | None, voxel_size: float, **wanted: Any
    ) -> trimesh.Trimesh:
        """What :meth:`mesh` answers; `wanted`: arguments of `_surface_mesh`."""
        from radarsdf.map.meshing import mesh_seen_from  # noqa: PLC0415 - trimesh is slow to import

        return mesh_seen_from(self, viewpoint, partial(self._surface_mesh, voxel_size, **wanted))

    def grid(
        self,
        box: ArrayLike,
        voxel_size: float = GRID_VOXEL_M,
        *,
        occupied_from: float = OCCUPIED_FROM,
        free_to: float = FREE_TO,
    ) -> Grid:
        """What is occupied, free and unknown in the voxels of a box, for planners.

        A voxel is occupied where a surface probably is: by its signed distance, with :meth:`uncertainty` and
        :meth:`confidence`. It is free only where rays passed it on the way to their returns, where no return is in it, and
        where all that is round it is known, too: next to the unknown there may be a surface that was not seen. Nor is it
        free where the surface of a neighbour may reach into it, by :meth:`uncertainty` and :meth:`confidence`. All else is
        unknown. How much rays tell is asked of the map itself: how often they pass what is behind its surfaces.

        What a radar does not see is not free. It sees nothing in its blind cone, outside of its field of view, nor nearer
        than its minimum range (``returns.min_range_m``): the ground under the sensor is unknown until it drove on. Smooth
        ground sends nothing back at flat angles and stays unknown. Glass and thin wires may send nothing back and be
        called free if rays to what is behind them passed often. Rays to ghosts do not count where they were found to be
        such; those that were not found may free a place behind a mirror.

        Parameters
        ----------
        box : (2, 3) array_like
            Lower and upper corner, world, m. The grid covers the box, extended to multiples of `voxel_size` in the world: grids
            of adjacent boxes fit together.
        voxel_size : float
            Edge of a voxel, m. Below that of a leaf cell, voxels are not better known. Above it, a voxel is occupied if a
            part of it is, and free only if it is throughout.
        occupied_from, free_to : float
            From which probability of a surface on a voxel is occupied, and up to which it may be free; ascending, in
            (0, 1). By default, scans must have passed it seven times as often as what is behind surfaces.

        Returns
        -------
        Grid
            Of places on true surfaces, at most 0.07 % are called free, on simulated places of all kinds.

        Raises
        ------
        ValueError
            If an argument is out of range, or the fit did not keep what rays passed (``returns.passages``).
        MemoryError
            If the box has more than 2²⁸ voxels.
        """
        from radarsdf.map.gridding import make_grid  # noqa: PLC0415 - as above

        return make_grid(self, box, voxel_size, occupied_from, free_to)

    def render(
        self,
        T_world_sensor: ArrayLike,
        sensor: Sensor | None = None,
        *,
        returns: float | None = None,
        noise: bool = False,
        seed: int | np.random.Generator = 0,
    ) -> View:
        """The returns that a radar would get from a pose, and what each of its beams first meets.

        Beams are traced to the surface that :meth:`mesh` keeps by default. Returns come from patches of the field's
        surface, most from those that answered often to the scans that looked there, and few from those that are
        hidden. They are the likeliest scan, not a random one: spread evenly, and on the surface.

        Parameters
        ----------
        T_world_sensor : (4, 4) array_like
            Pose of the sensor, m. Its frame: x forward, y left, z up.
        sensor : Sensor, optional
            The radar. Default: that of the scans of the fit, :attr:`sensor`.
        returns : float, optional
            Number of returns before those below the sensor's threshold are left out; at most as many as the surface in
            view has patches. Default: what the sensor gives. More returns show more of what it can see.
        noise : bool
            Whether the returns have the sensor's noise in range, azimuth and elevation.
        seed : int or numpy.random.Generator
            Of the noise. No global generator is touched.

        Returns
        -------
        View
            The first call for a map prepares its surface, which takes about a second for each million leaf cells. Of a
            map in tiles, that within the sensor's range is held until a view needs others.

        Raises
        ------
        ValueError
            If the pose is not a rigid transform, or a number is out of range.
        MemoryError
            If the view would take more memory than there is. At most 10^6 beams are traced, and a patch has one return.
        """
        from radarsdf.map.views import view_from  # noqa: PLC0415 - as above

        pose = check_pose(T_world_sensor, "T_world_sensor")
        sensor = self.sensor if sensor is None else instance(sensor, Sensor, "sensor")
        viewed = self._viewed_from(pose[:3, 3], sensor.range_m[1])
        return view_from(viewed, pose, sensor, returns, noise=noise, seed=seed)

    @abstractmethod
    def save(self, path: str | PathLike[str]) -> None:
        """Writes the map to a safetensors file. After :func:`radarsdf.load`, all results have the same bits.

        An old file is replaced only once the new one is complete. An OSError says why it cannot be written.
        """

    @property
    @abstractmethod
    def config(self) -> FitConfig:
        """Settings of the fit."""

    @property
    @abstractmethod
    def report(self) -> dict[str, Any]:
        """Counts, losses, noise of the sensor and seconds of the fit. `skipped`: parts of the method it did not run."""

    @property
    @abstractmethod
    def sensor(self) -> Sensor:
        """The radar, as the scans of the fit show it."""

    @property
    @abstractmethod
    def intensity_scale(self) -> IntensityScale | None:
        """Range of the training intensities, sensor units. None: the map was fitted without intensities."""

    @property
    def has_intensity(self) -> bool:
        """Whether intensities were given to the fit."""
        return self.intensity_scale is not None

    @property
    @abstractmethod
    def rough_share(self) -> float:
        """Share of the returns that lie on no thin surface, in [0, 1]: clutter, vegetation, rough ground."""

    @property
    @abstractmethod
    def origin(self) -> NDArray[np.float64]:
        """(3,) float64, origin of the local frame in world coordinates, m."""

    @property
    @abstractmethod
    def extent(self) -> NDArray[np.float64]:
        """(2, 3) lower and upper corner of all leaf cells, world, m."""

    @property
    @abstractmethod
    def num_cells(self) -> int:
        """Number of leaf cells."""

    @property
    @abstractmethod
    def file_bytes(self) -> int:
        """Size of the file that :meth:`save` writes, without the names of its arrays: less than 4 kB; bytes."""
