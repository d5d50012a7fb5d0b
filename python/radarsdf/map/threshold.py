# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which triangles a mesh keeps: its limits, and the confidence at which the expected F-score is highest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import number, whole_number
from radarsdf.map.queries import VOXEL_M

Floats = NDArray[np.float64]

_BINS = 1000  # of the confidences from 0 to 1
_SCALARS = 3
TALLY_NUMBERS = 3 * _BINS + _SCALARS  # of a :class:`Tally`
_COMPONENT_TRIANGLES = 30  # of the smallest component that is kept, in voxels of VOXEL_M


class Limits(NamedTuple):
    """Which triangles a mesh keeps; see :meth:`Map.mesh`."""

    min_confidence: float | None  # None: that of the highest expected F-score
    max_uncertainty: float  # m
    min_component_triangles: int

    @classmethod
    def of(
        cls,
        voxel_m: float,
        *,
        min_confidence: float | None = None,
        max_uncertainty: float | None = None,
        min_component_triangles: int | None = None,
    ) -> Limits:
        """The arguments of :meth:`Map.mesh`, checked, with defaults filled in."""
        if min_confidence is not None:
            min_confidence = number(min_confidence, "min_confidence")
        if not 0 <= (min_confidence or 0) <= 1:
            msg = f"min_confidence must be in [0, 1], not {min_confidence}"
            raise ValueError(msg)
        max_uncertainty = number(math.inf if max_uncertainty is None else max_uncertainty, "max_uncertainty")
        if max_uncertainty < 0:
            msg = f"max_uncertainty must be at least 0, not {max_uncertainty}"
            raise ValueError(msg)
        if min_component_triangles is None:
            # In larger voxels fewer, of more area.
            min_component_triangles = round(_COMPONENT_TRIANGLES * min(1.0, VOXEL_M / voxel_m))
        components = whole_number(min_component_triangles, "min_component_triangles", 0)
        return cls(min_confidence, max_uncertainty, components)

    def met(
        self, threshold: float, confidence: NDArray[np.float32], uncertainty_m: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """(V,) whether vertices meet the limits, at this threshold of the confidence. A NaN meets no finite uncertainty."""
        certain = np.nan_to_num(uncertainty_m, nan=np.inf) <= self.max_uncertainty
        found: NDArray[np.bool_] = certain & (confidence >= threshold)
        return found


@dataclass(frozen=True)
class Threshold:
    """The least confidence of a mesh, and what is expected of it. The names are those in the ``metadata`` of a mesh."""

    min_confidence: float  # in [0, 1]; surface of less is left out
    expected_precision: float  # share of the area kept that is expected to be true; 0 if nothing is kept
    # Share of the observed surface, that which returns lie on, that it is expected to cover; 0 if none is expected. Surface
    # that no ray reached does not count: the share of all that is there may be far smaller.
    coverage_of_observed: float
    whole_precision: float  # the same two if all surface were kept, whatever its confidence
    whole_coverage_of_observed: float

    @classmethod
    def of_mesh(cls, metadata: Mapping[str, Any]) -> Threshold:
        return cls(**{name: metadata[name] for name in cls.__dataclass_fields__})

    @property
    def metadata(self) -> dict[str, float]:
        return asdict(self)

    def __str__(self) -> str:
        return (
            f"kept from a confidence of {self.min_confidence:.2f} on: {self.expected_precision:.0%} of it is expected to be "
            f"true, and to cover {self.coverage_of_observed:.0%} of the surface that returns lie on; of all surface that was "
            f"found, {self.whole_precision:.0%} and {self.whole_coverage_of_observed:.0%}"
        )


@dataclass(frozen=True)
class Tally:
    """Area of a map's surface by confidence. Sums over parts of a map, such as tiles, are those of the whole."""

    area_m2: Floats  # (B,) of the surface in each of B equal bins of the confidence from 0 to 1
    true_m2: Floats  # (B,) expected true area of it
    covering: Floats  # (B,) true surface that is newly covered as the confidence falls. Only ratios count
    existing_m2: float  # expected true surface, whether or not its position is known well enough
    once_m2: float  # expected true surface that has a return of one scan in one cell
    twice_m2: float  # … of two

    @classmethod
    def of(cls, area_m2: Floats, confidence: Floats, covering: Floats, reach: Floats, hits: Floats) -> Tally:
        """Of a surface by its vertices: areas by ``vertex_areas`` of the core, and numbers of :mod:`queries`, (V,) each."""
        true_m2 = confidence * area_m2
        bins = np.minimum((confidence * _BINS).astype(np.int64), _BINS - 1)
        existing_m2 = np.divide(true_m2, reach, out=np.zeros_like(true_m2), where=true_m2 > 0)
        scans = np.round(hits)

        columns = (area_m2, true_m2, covering * area_m2)
        sums = [np.bincount(bins, values, _BINS) for values in columns]
        scalars = (np.minimum(existing_m2, area_m2), true_m2[scans == 1], true_m2[scans == 2])
        return cls.of_sums(np.concatenate([*sums, [values.sum() for values in scalars]]))

    def sums(self) -> Floats:
        return np.concatenate([np.atleast_1d(values) for values in astuple(self)])

    @classmethod
    def of_sums(cls, sums: Floats) -> Tally:
        area_m2, true_m2, covering = sums[:-_SCALARS].reshape(-1, _BINS)
        existing_m2, once_m2, twice_m2 = sums[-_SCALARS:].tolist()
        return cls(area_m2, true_m2, covering, existing_m2, once_m2, twice_m2)

    def threshold(self, min_confidence: float | None = None) -> Threshold:
        """The threshold of the highest expected F-score, or the expectations at a given one."""
        kept_m2, true_m2, covering = (
            np.cumsum(values[::-1])[::-1] for values in (self.area_m2, self.true_m2, self.covering)
        )
        precision = np.divide(true_m2, kept_m2, out=np.zeros_like(true_m2), where=kept_m2 > 0)
        coverage = covering / covering[0] if covering[0] > 0 else covering
        if min_confidence is None:
            total = precision + self.reachable * coverage
            # Over twice the reachable share, which is the same for all: if nothing can be reached, all is kept.
            f_score = np.divide(precision * coverage, total, out=np.zeros_like(total), where=total > 0)
            row = int(np.flatnonzero(f_score == f_score.max())[-1]) if f_score.any() else 0
            min_confidence = row / _BINS
        else:
            row = min(round(min_confidence * _BINS), _BINS - 1)
        coverage = self.reachable * coverage
        expected = (precision[row], coverage[row], precision[0], coverage[0])
        return Threshold(min_confidence, *map(float, expected))

    @property
    def reachable(self) -> float:
        """Share of the observed surface that can be covered: it has returns, and lies near enough to where it was found."""
        # Of the surface that these scans could have hit, at least once² / (2 · twice) has no return: Chao's estimate of
        # species that no sample has. Surface that no ray reaches leaves no trace in these counts.
        true_m2 = float(self.true_m2.sum())
        if true_m2 == 0 or (self.once_m2 > 0 and self.twice_m2 == 0):
            return 0.0
        unseen_m2 = self.once_m2**2 / (2 * self.twice_m2) if self.once_m2 > 0 else 0.0
        return true_m2 / (true_m2 + unseen_m2) * true_m2 / self.existing_m2


def across_triangles(vertices: Floats, faces: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """(F, 3) normals of triangles (F, 3), twice as long as their areas, and (F,) these lengths, m²."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across, np.sqrt(np.einsum("ni,ni->n", across, across))
