"""Subject of a report: a map and the data it is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from radarsdf.arrays import Floats
from radarsdf.checking.recording import Finding
from radarsdf.map.map import Map
from radarsdf.scans import Scans
from radarsdf.view.surface import thinned

MAX_VERTICES = 160_000  # limit of the mesh in the 3D scene and the pictures, which is thinned above it


@dataclass(frozen=True)
class Subject:
    """A map and the data it is compared with."""

    radar_map: Map
    name: str  # title of the page
    scans: Scans | None = None  # those fitted, or those to compare with
    held_out: Scans | None = None  # those that the fit left out, if known
    findings: Sequence[Finding] | None = None  # result of `radarsdf.check` on all scans; None: not checked
    voxel_size_m: float = 0.1  # voxels of the evaluated mesh
    box: ArrayLike | None = None  # (2, 3) corners of the reported part of the world, m; None: all
    progress: bool | None = None
    limits: Mapping[str, Any] = field(default_factory=dict)  # limits of the mesh: arguments of `Map.mesh`

    @property
    def viewpoint(self) -> Floats:
        """(3,) sensor position for predicted intensities: that of the middle scan, or the map's origin; world, m."""
        if self.scans is None:
            return self.radar_map.origin
        return np.asarray(self.scans.sensor_poses[len(self.scans) // 2, :3, 3], np.float64)

    @cached_property
    def mesh(self) -> Any:
        """The evaluated mesh, with intensities if the map has any."""
        viewpoint = self.viewpoint if self.radar_map.has_intensity else None
        limits: dict[str, Any] = {**self.limits, "box": self.box, "viewpoint": viewpoint}
        return self.radar_map.mesh(self.voxel_size_m, progress=self.progress, **limits)

    @cached_property
    def shown(self) -> tuple[Any, float]:
        """The drawn mesh, and its vertex spacing, m."""
        return thinned(self.mesh, MAX_VERTICES, self.voxel_size_m)

    @cached_property
    def ground_truth(self) -> Floats | None:
        """(M, 3) ground-truth points in the box, world, m; None if there are none."""
        if self.scans is None or self.scans.ground_truth is None:
            return None
        truth = np.asarray(self.scans.ground_truth, np.float64)
        if self.box is not None:
            low, high = np.asarray(self.box, np.float64)
            truth = truth[((truth >= low) & (truth <= high)).all(axis=1)]
        return truth if len(truth) else None

    @cached_property
    def truth_tree(self) -> Any:
        """k-d tree of the ground-truth points, which must exist."""
        return cKDTree(self.ground_truth)
