"""The interface of maps: public queries, and the abstract methods behind them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from radarsdf import checks
from radarsdf.arrays import Array, ArrayLike, Bools, Floats, Mesh
from radarsdf.checks import MAX_POSITION_M, AnyPath, check, check_pose, positive, real_array
from radarsdf.config.fit_config import FitConfig
from radarsdf.map import queries
from radarsdf.map.colors import Scale
from radarsdf.map.confidence import CellsInBox, EvidenceAt, confidence, free_space_odds, uncertainty
from radarsdf.map.threshold import VOXEL_M
from radarsdf.map.view import DepthImage, View, ViewedMap, view_from
from radarsdf.memory import check_views
from radarsdf.products import turned
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import ViewStatisticsAt
from radarsdf.rig import Label

Query = Callable[..., Array]


class Map(ABC):
    """Surface and reflectance of a scene: the interface of :class:`RadarMap` and :class:`TiledMap`.

    Queries take world coordinates, m, as array_like or CPU tensors of shape (N, 3), and return the same kind: float64 for
    float64 input and lists, float32 otherwise. Coordinates are converted to the local frame in float64, so large ones such as
    UTM lose no precision. A wrong shape raises a ValueError; values that are not real numbers, or a tensor on another device,
    raise a TypeError. Queries are thread-safe, and a map can be pickled.

    A map covers the leaf cells near returns, see :meth:`observed`. Elsewhere, free space included, and at non-finite positions,
    signed distance, gradient and intensity are NaN. Without returns near a position, the uncertainty is NaN and the confidence 0.
    """

    def sdf(self, x: Any, *, extrapolate: bool = False, return_gradient: bool = False) -> Any:
        """Compute the signed distance to the surface.

        Parameters
        ----------
        x : (N, 3) array_like or Tensor
            World, m.
        extrapolate : bool
            Whether to evaluate the field also where nothing was observed. Its values are meaningless there.
        return_gradient : bool
            Whether to return the pair of the distance and :meth:`gradient`, which takes little longer than the latter alone.

        Returns
        -------
        (N,) ndarray or Tensor
            Signed distance, m: positive in free space, zero on the surface, negative behind it. NaN where `x` was not
            :meth:`observed`, or is not finite. Learnt along rays, it exceeds the Euclidean distance at grazing incidence.
        """
        world, answer = as_positions(x)
        if return_gradient:
            planes = self._evaluate(queries.plane, world, extrapolate=extrapolate)
            return answer(planes[:, 0]), answer(planes[:, 1:])
        return answer(self._evaluate(queries.signed_distance, world, extrapolate=extrapolate))

    def gradient(self, x: Any, *, extrapolate: bool = False) -> Any:
        """Compute the gradient of the signed distance; the arguments are those of :meth:`sdf`.

        Returns
        -------
        (N, 3) ndarray or Tensor
            Derivatives along x, y and z of the world, pointing to free space. The norm is about 1 where rays met the surface at
            normal incidence, and larger at grazing incidence. NaN where :meth:`sdf` is.
        """
        return self.sdf(x, return_gradient=True, extrapolate=extrapolate)[1]

    def observed(self, x: Any) -> Any:
        """Test whether positions `x` (N, 3) lie in or on the border of a leaf cell, near returns or in a small gap between them.

        Where the result, (N,) bool, is False, :meth:`sdf`, :meth:`gradient` and :meth:`intensity` are NaN.
        """
        world, answer = as_positions(x)
        return answer(self._observed(world))

    def uncertainty(self, x: Any) -> Any:
        """Estimate the standard error of the surface's position, from the noise of the returns near positions `x` (N, 3).

        Returns
        -------
        (N,) ndarray or Tensor
            (Σ 1 / σ²)^-½ over the returns in the 27 leaf cells near `x`, interpolated between cells, plus a floor in quadrature,
            m. σ is the noise of a return along and across the beam, see ``report["noise"]``, and grows with the range. The
            floor, independent of the number of returns, is 0.05 leaf cells, plus up to 1.1 depending on :attr:`clutter_ratio`.
            NaN where there are no returns near `x`, or `x` is not finite. Pose errors are included if ``returns.pose_sigma_m``
            and ``pose_sigma_rad`` of the :class:`FitConfig` specify them.
        """
        world, answer = as_positions(x)
        return answer(uncertainty(self.contents_of_any, self.evidence_at(world)))

    def confidence(self, x: Any) -> Any:
        """Estimate the probability of a surface, from the returns near positions `x` (N, 3) and the scans that reached them.

        Returns
        -------
        (N,) ndarray or Tensor
            Probability, in [0, 1], that a true surface is within a leaf cell's edge. 0 where there are no returns near `x`,
            or `x` is not finite.

        Notes
        -----
        A logistic regression on the precision of the returns, the number of missing returns given the scans that reached the
        place, the map's clutter ratio, and its returns per cell. It was trained on simulated scenes and five real drives; on
        other kinds of scenes, the worst tenth is mostly within 0.1 to 0.3 of the share of true surface.
        """
        world, answer = as_positions(x)
        return answer(confidence(self.contents_of_any, self.evidence_at(world)))

    def intensity(
        self,
        x: Any,
        sensor_positions: Any,
        *,
        sensor: Sensor | Label | None = None,
        extrapolate: bool = False,
    ) -> Any:
        """Predict the intensity of the return that a sensor would measure at each position.

        Only views like those of the fit are predicted: within a factor of 1.7 of the range, and 4° of the elevation, of a return.

        Parameters
        ----------
        x : (N, 3) array_like or Tensor
            World, m.
        sensor_positions : (N, 3) or (3,) array_like or Tensor
            World, m.
        sensor : Sensor or label, optional
            The radar in whose unit intensities are. Default: the first of the fit.
        extrapolate : bool
            Whether to predict also where nothing was observed and for views unlike those of all returns, there with ranges
            clipped to those of the fit. Such values are meaningless.

        Returns
        -------
        (N,) ndarray or Tensor
            Intensity, sensor units. NaN where `x` was not :meth:`observed`, for other views, or if a position is not finite.

        Raises
        ------
        ValueError
            If the map has no intensities, or no radar of this label.
        """
        radar = self._radar(sensor)
        check(self.has_intensity, "this map was fitted without intensities")
        world, answer = as_positions(x)
        sensors, _ = as_positions(sensor_positions, rows=len(world))
        query = partial(queries.intensity, extrapolate=extrapolate)
        return answer(radar.measured(self._evaluate(query, world, sensors, extrapolate=extrapolate)))

    def mesh(
        self,
        voxel_size: float = VOXEL_M,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        min_confidence: float | None = None,
        max_uncertainty: float | None = None,
        min_component_triangles: int | None = None,
        progress: bool | None = None,
    ) -> Mesh:
        """Extract the surface as triangles, by marching cubes in the leaf cells of the map.

        Parameters
        ----------
        voxel_size : float
            Edge of a voxel, m.
        box : (2, 3) array_like, optional
            Lower and upper corner, world, m. Only voxels with their centre inside are meshed. Default: the whole map.
        viewpoint : (3,) array_like, optional
            Sensor position, world, m, for which intensities are predicted at the vertices.
        min_confidence : float, optional
            In [0, 1]. Triangles with a vertex of lower :meth:`confidence` are left out. Default: the value that maximises
            the expected F-score of the observed surface. 0 keeps all (3QFP).
        max_uncertainty : float, optional
            Triangles with a vertex of higher or unknown :meth:`uncertainty`, m, are left out. Default: no limit;
            uncertain surface has a low confidence, too.
        min_component_triangles : int, optional
            Connected components of fewer remaining triangles are left out. Default: 30 in voxels of up to 0.1 m, fewer in
            larger ones, 15 at 0.2 m (3QFP: 300, which on sparse scans costs ten points of completion).
        progress : bool, optional
            Whether to show a progress bar. Default: only on a terminal.

        Returns
        -------
        trimesh.Trimesh
            World frame, m. Triangles and vertex normals face free space. Empty if there is no surface.

            - ``vertex_attributes``: `confidence` and `uncertainty_m`, (V,) float32. With a viewpoint also `intensity`,
              sensor units, and vertex colours for it, from dark (low) to bright (high); grey where :meth:`intensity` is NaN.
            - ``metadata``: `leaf_cells` of the map, and `leaf_cells_searched`, those that may contain surface;
              the applied `min_confidence`; `expected_precision`, the share of the mesh that is expected to be true;
              `coverage_of_observed`, the expected share of the surface with returns that the mesh covers;
              `whole_precision` and `whole_coverage_of_observed`, the same if all were kept. Surface that no ray reached is not
              counted: the mesh may cover far less of the whole scene.

        Raises
        ------
        ValueError
            If an argument is out of range, or there is a viewpoint but the map has no intensities.
        MemoryError
            If the voxels need more memory than ``config.max_memory_bytes``, or than the system has left.
        """
        scale = self.intensity_scale
        if viewpoint is not None:
            check(scale, "a viewpoint needs a map with intensities; this one was fitted without")
            sensor_position = real_array(viewpoint, "viewpoint")
            is_position = sensor_position.shape == (3,) and (np.abs(sensor_position) <= MAX_POSITION_M).all()
            check(is_position, f"viewpoint must be one position (3,), finite and within {MAX_POSITION_M:g} m")
        limits = {"min_confidence": min_confidence, "max_uncertainty": max_uncertainty}
        limits["min_component_triangles"] = min_component_triangles
        mesh = self._surface_mesh(voxel_size, box=box, progress=progress, **limits)
        if viewpoint is None or scale is None:
            return mesh
        values = self.intensity(np.array(mesh.vertices, np.float64), sensor_position).astype(np.float32)
        mesh.vertex_attributes["intensity"] = values
        mesh.visual.vertex_colors = Scale(scale.low, scale.high)(values)
        return mesh

    def render(
        self,
        T_world_sensor: ArrayLike,
        sensor: Sensor | Label | None = None,
        *,
        returns: float | None = None,
        noise: bool = False,
        seed: int | np.random.Generator = 0,
    ) -> View:
        """Predict the scan of a radar at a pose, and the first surface along each of its beams.

        Beams are traced to the surface that :meth:`mesh` keeps by default. Returns are placed on patches of the field's surface in
        proportion to the number expected from the detection rate of each patch: the likeliest scan, not a random one.

        Parameters
        ----------
        T_world_sensor : (4, 4) array_like
            Pose of the sensor, m. Its frame: x forward, y left, z up.
        sensor : Sensor or label, optional
            The radar, or its label in :attr:`sensors`. Default: :attr:`sensor`, estimated from the scans of the fit.
        returns : float, optional
            Number of returns before those below the sensor's threshold are left out; at most one for each patch in view.
            Default: the sensor's number. More returns show more of the visible surface.
        noise : bool
            Whether to add the sensor's noise in range, azimuth and elevation.
        seed : int or numpy.random.Generator
            Seed of the noise. No global generator is used.

        Returns
        -------
        View
            The first call for a map extracts its surface, which takes about a second per million leaf cells. For a map in
            tiles, the part within the sensor's range is cached until a view needs another one.

        Raises
        ------
        ValueError
            If the pose is not a rigid transform, a number is out of range, or the map has no radar of this label.
        TypeError
            If `sensor` is neither a :class:`Sensor` nor a label of several radars.
        MemoryError
            If the view would need more memory than available. At most 10^6 beams are traced.
        """
        pose = check_pose(T_world_sensor, "T_world_sensor")
        radar = self._radar(sensor)
        viewed = self._viewed_from(pose[:3, 3], radar.range_m[1])
        return view_from(viewed, pose, radar, returns, noise=noise, seed=seed)

    def render_depth(
        self,
        T_world_camera: ArrayLike,
        camera: ArrayLike,
        size: tuple[int, int],
        *,
        max_range_m: float = 100.0,
    ) -> DepthImage:
        """Render the surface that :meth:`mesh` keeps by default, as seen by a pinhole camera.

        Parameters
        ----------
        T_world_camera : (4, 4) array_like
            Pose of the camera, m: x right, y down, z forward, as in OpenCV and ROS's optical frames.
        camera : (3, 3) array_like
            Intrinsic matrix, pixels, as ``K`` of ROS's ``CameraInfo``. Pixel centres are integers.
        size : (int, int)
            Width and height of the image, pixels.
        max_range_m : float
            Largest distance of surface from the camera, m.

        Returns
        -------
        DepthImage
            Depth, normals and :meth:`confidence` of each pixel.

        Raises
        ------
        ValueError
            If the pose is not a rigid transform, the matrix is singular, or another argument is out of range.
        MemoryError
            If the image would need more memory than available.
        """
        pose, K = check_pose(T_world_camera, "T_world_camera"), real_array(camera, "camera")
        invertible = K.shape == (3, 3) and np.linalg.matrix_rank(K) == 3
        check(invertible, f"camera must be an invertible (3, 3) matrix, not {K}")
        width, height = (checks.whole_number(count, "size", 1) for count in size)
        check_views(self.config.max_memory_bytes, beams=width * height)
        range_m, position = positive(max_range_m, "max_range_m"), pose[:3, 3]
        viewed = self._viewed_from(position, range_m)
        v, u = np.indices((height, width)).reshape(2, -1)
        pixels = np.stack([u, v, np.ones_like(u)], axis=1)
        rays = turned(turned(pixels, np.linalg.inv(K)), pose[:3, :3])  # depth 1
        length = np.linalg.norm(rays, axis=1)
        depth_m = viewed.ranges(position - viewed.origin, rays / length[:, None], range_m) / length
        seen = np.isfinite(depth_m)
        points = position + depth_m[seen, None] * rays[seen]
        image = np.full((height, width, 5), np.nan, np.float32)
        of_points = depth_m[seen], self.tangent_planes(points)[1], self.confidence(points)
        image[seen.reshape(height, width)] = np.column_stack(of_points)
        return DepthImage(image[..., 0], image[..., 1:4], image[..., 4])

    def _radar(self, sensor: Sensor | Label | None) -> Sensor:
        if sensor is None:
            return self.sensor
        if isinstance(sensor, Sensor) or not self.sensors:
            return checks.instance(sensor, Sensor, "sensor")
        known = ", ".join(map(str, self.sensors))
        check(sensor in self.sensors, f"the map has no radar {sensor!r:.50}; its radars are {known}")
        return self.sensors[sensor]

    @abstractmethod
    def save(self, path: AnyPath) -> None:
        """Write the map to a safetensors file. After :func:`radarsdf.load`, all results are bit-identical.

        An existing file is replaced only once the new one is complete. Raises an OSError if the file cannot be written.
        """

    @property
    def config(self) -> FitConfig:
        """Settings of the fit."""
        return self.contents_of_any.config

    @property
    def report(self) -> dict[str, Any]:
        """Counts, losses, sensor noise and times, s, of the fit. `skipped`: parts of the method that it did not run."""
        return self.contents_of_any.report

    @property
    def sensor(self) -> Sensor:
        """The radar, estimated from the scans of the fit; of several, all as one, with intensities in the unit of the first."""
        return self.contents_of_any.sensor

    @property
    def sensors(self) -> dict[Label, Sensor]:
        """The radars of the fit by label, if there were several, each with its own noise and unit of intensities."""
        return self.contents_of_any.sensors

    @property
    def intensity_scale(self) -> IntensityScale | None:
        """Range of the training intensities, sensor units. None: the map was fitted without intensities."""
        return self.contents_of_any.intensity_scale

    @property
    def has_intensity(self) -> bool:
        """Whether the map was fitted with intensities."""
        return self.intensity_scale is not None

    @property
    def clutter_ratio(self) -> float:
        """Share of the returns that do not lie on a thin surface, in [0, 1]."""
        return self.contents_of_any.clutter_ratio

    @property
    @abstractmethod
    def origin(self) -> Floats:
        """Origin of the local frame, (3,) float64, world, m. Queries subtract it in float64."""

    @property
    @abstractmethod
    def extent(self) -> Floats:
        """Lower and upper corner of the bounding box of all leaf cells, (2, 3) float64, world, m."""

    @property
    @abstractmethod
    def num_cells(self) -> int:
        """Number of leaf cells, int."""

    @property
    @abstractmethod
    def file_bytes(self) -> int:
        """Size of the file that :meth:`save` writes, without its header of up to 4 kB: int, bytes."""

    # Interface for grids, comparisons and views, and the abstract methods, at positions (N, 3), world, m.

    @abstractmethod
    def cells_near(self, lower: Floats, upper: Floats) -> CellsInBox:
        """Return free space and returns in the leaf cells that overlap the box of two corners (3,), world, m."""

    @abstractmethod
    def evidence_at(self, world: Floats) -> EvidenceAt:
        """Return the evidence of a surface at positions (N, 3), world, m."""

    @abstractmethod
    def view_statistics(self) -> ViewStatisticsAt:
        """Return view statistics of intensity, empty without intensities or ``returns.free_space``."""

    @property
    @abstractmethod
    def contents_of_any(self) -> queries.MapContents:
        """The contents of the map, or of any of its tiles, for properties that all share."""

    @cached_property
    def free_space_odds(self) -> Floats:
        """See :func:`radarsdf.map.confidence.free_space_odds`."""
        return free_space_odds(self.contents_of_any)

    @abstractmethod
    def _evaluate(self, query: Query, world: Floats, *others: Floats, extrapolate: bool) -> Array:
        """Evaluate a query of :mod:`queries` where observed (`extrapolate`: at finite positions) and others finite; else NaN."""

    @abstractmethod
    def _observed(self, world: Floats) -> Bools: ...

    @abstractmethod
    def _surface_mesh(self, voxel_size: float, *, box: Any, progress: bool | None, **wanted: Any) -> Any:
        """:meth:`Map.mesh` without intensities. `wanted`: its arguments except the viewpoint."""

    def meshes(self, voxel_size: float) -> Iterable[Mesh]:
        """Return :meth:`mesh` at this voxel size, m, in parts, of which only one need be in memory at a time."""
        return [self.mesh(voxel_size, progress=False)]

    @abstractmethod
    def _viewed_from(self, position: Floats, range_m: float) -> ViewedMap:
        """Return the data for views from a position (3,) within a range, cached for the next view."""

    def tangent_planes(self, x: Floats) -> tuple[Floats, Floats]:
        """Linearise the surface at positions (N, 3), world, m: signed distances (N,), m, to planes, and unit normals (N, 3)."""
        sdf, gradient = self.sdf(x, return_gradient=True)
        length = np.linalg.norm(gradient, axis=1)
        # At grazing incidence the field exceeds the distance, and its gradient exceeds 1, by the same factor.
        return sdf / np.maximum(length, 1), gradient / length[:, None].clip(1e-9)


def as_positions(x: Any, rows: int | None = None) -> tuple[Floats, Callable[[Array], Any]]:
    """Convert `x` to positions (N, 3), and return a function that converts results back; (3,) is broadcast to `rows`."""
    is_tensor = isinstance(x, Tensor)
    if is_tensor and (x.device.type != "cpu" or x.layout != torch.strided or x.is_complex()):
        msg = f"positions must be real numbers in a dense tensor on the CPU, not {x.dtype} {x.layout} on {x.device}"
        raise TypeError(msg)
    world = x.detach().double().numpy() if is_tensor else real_array(x, "positions")
    if rows is not None and world.shape == (3,):
        world = np.broadcast_to(world, (rows, 3))
    fits = world.ndim == 2 and world.shape[1] == 3 and rows in (None, len(world))
    check(fits, f"positions must have shape (N, 3), not {world.shape}")
    keep_double = getattr(x, "dtype", None) in (torch.float64, np.dtype(np.float64), None)

    def answer(result: Array) -> Any:
        kind = result.dtype if result.dtype == np.bool_ else np.float64 if keep_double else np.float32
        array = np.ascontiguousarray(result, kind)
        return torch.from_numpy(array) if is_tensor else array

    return world, answer
