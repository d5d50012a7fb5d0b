# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What each kind of map answers in its own way, for the questions of ``Map``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.returns.view_statistics import EchoesAt

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.gridding import CellsInBox
    from radarsdf.map.views import ViewedMap


class MapParts(ABC):
    """Answers at positions that were checked, and what grids and comparisons of maps read."""

    @abstractmethod
    def cells_round(self, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> CellsInBox:
        """What is known of the leaf cells that lie between two corners (3,), world, m, wholly or in part."""

    @abstractmethod
    def evidence_at(self, world: Tensor) -> queries.EvidenceAt:
        """What the returns round positions (N, 3), world, m, tell of a surface there."""

    @property
    @abstractmethod
    def _contents_of_any(self) -> MapContents:
        """The parts of the map, or of one of its tiles, for what all have in common."""

    @cached_property
    def passage_odds(self) -> NDArray[np.float64]:
        """(8,) how much more often 0 to 7 or more scans pass a leaf cell behind a surface than one before it."""
        from radarsdf.map.gridding import passage_odds  # noqa: PLC0415 - it imports trimesh, which is slow

        return passage_odds(self._contents_of_any)

    @abstractmethod
    def echoes(self) -> EchoesAt:
        """How strong the returns of the fit were. Empty without intensities, or without ``returns.passages``."""

    @abstractmethod
    def _sdf(self, world: Tensor, extrapolate: bool) -> Tensor:
        """:meth:`Map.sdf` at positions (N, 3) in the world, m: (N,)."""

    @abstractmethod
    def _gradient(self, world: Tensor, extrapolate: bool) -> Tensor:
        """:meth:`Map.gradient` there, (N, 3)."""

    def plane_at(self, world: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`Map.sdf` and :meth:`Map.gradient` at positions (N, 3) in the world, m."""
        return self._sdf(world, False), self._gradient(world, False)

    @abstractmethod
    def _observed(self, world: Tensor) -> Tensor:
        """:meth:`Map.observed` there, (N,) bool."""

    def surface_at(self, world: Tensor) -> tuple[queries.EvidenceAt, Tensor, Tensor]:
        """:meth:`evidence_at`, :meth:`Map.uncertainty` and :meth:`Map.confidence` at positions (N, 3) in the world, m."""
        evidence, contents = self.evidence_at(world), self._contents_of_any
        return evidence, queries.uncertainty(contents, evidence), queries.confidence(contents, evidence)

    def _uncertainty(self, world: Tensor) -> Tensor:
        """:meth:`Map.uncertainty` there, (N,)."""
        return self.surface_at(world)[1]

    def _confidence(self, world: Tensor) -> Tensor:
        """:meth:`Map.confidence` there, (N,)."""
        return self.surface_at(world)[2]

    @abstractmethod
    def _intensity(self, world: Tensor, sensors: Tensor, extrapolate: bool) -> Tensor:
        """:meth:`Map.intensity` there, (N,), for sensors at (N, 3)."""

    @abstractmethod
    def _surface_mesh(self, voxel_size: float, **wanted: Any) -> trimesh.Trimesh:
        """:meth:`Map.mesh` without intensities. `wanted`: its arguments but for the viewpoint."""

    @abstractmethod
    def _viewed_from(self, position: NDArray[np.float64], range_m: float) -> ViewedMap:
        """What views from a position (3,), world, m, need of the map within a range. It is held for the next view."""
