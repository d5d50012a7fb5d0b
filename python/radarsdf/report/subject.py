# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a report is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from radarsdf.checking.recording import Finding
from radarsdf.io.scans import Scans, TruthKind
from radarsdf.map.map import Map
from radarsdf.view.thinning import thinned

MOST_VERTICES = 160_000
"""In the 3D scene and the pictures. A larger mesh is thinned for them."""


@dataclass(frozen=True)
class Subject:
    """A map, and what is known besides it."""

    radar_map: Map
    name: str
    """Of the map, for the heading."""
    scans: Scans | None = None
    """The scans that the map was fitted to, or those that it is compared with. None: the map stands alone."""
    held_out: Scans | None = None
    """Scans that the fit left out. None: there are none, or it is not known which."""
    findings: Sequence[Finding] | None = None
    """What :func:`radarsdf.check` says of all scans. None: it was not asked."""
    voxel_size_m: float = 0.1
    """Edge of the voxels of the mesh that is measured."""
    box: ArrayLike | None = None
    """(2, 3) the part of the world that counts, m. None: all."""
    progress: bool | None = None
    """As for :meth:`Map.mesh`."""
    limits: Mapping[str, Any] = field(default_factory=dict)
    """What the mesh leaves out, such as `min_confidence`: as :meth:`Map.mesh`."""

    @property
    def viewpoint(self) -> NDArray[np.float64]:
        """(3,) sensor position for which intensities are predicted: of the middle scan, or the mean of all; world, m."""
        if self.scans is None:
            return self.radar_map.origin
        return np.asarray(self.scans.poses[len(self.scans) // 2, :3, 3], np.float64)

    @cached_property
    def mesh(self) -> Any:
        """The mesh that is measured, with intensities if the map has any."""
        viewpoint = self.viewpoint if self.radar_map.has_intensity else None
        return self.radar_map.mesh(
            self.voxel_size_m, box=self.box, viewpoint=viewpoint, progress=self.progress, **self.limits
        )

    @cached_property
    def shown(self) -> tuple[Any, float]:
        """The mesh that is shown, and how far apart its vertices are, m."""
        return thinned(self.mesh, MOST_VERTICES, self.voxel_size_m)

    @cached_property
    def ground_truth(self) -> NDArray[np.float64] | None:
        """(M, 3) points of the truth in the box, world, m. None if there are none."""
        truth = None if self.scans is None else self.scans.ground_truth
        if truth is None:
            return None
        truth = np.asarray(truth, np.float64)
        if self.box is not None:
            low, high = np.asarray(self.box, np.float64)
            truth = truth[((truth >= low) & (truth <= high)).all(axis=1)]
        return truth if len(truth) else None

    @property
    def truth_kind(self) -> TruthKind:
        """Where the truth comes from."""
        return "lidar" if self.scans is None else self.scans.truth_kind

    @cached_property
    def truth_tree(self) -> Any:
        """The points of the truth, to be asked for the nearest. Only where there are some."""
        return cKDTree(self.ground_truth)
