"""Limits of the triangles that a mesh keeps, and the confidence threshold of the highest expected F-score."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from radarsdf.arrays import Bools, Floats, Floats32
from radarsdf.checks import check, number, whole_number

VOXEL_M = 0.1
"""Default edge of a mesh's voxels, m."""
_BINS = 1000  # bins of the confidence from 0 to 1
_SCALARS = 3
TALLY_NUMBERS = 3 * _BINS + _SCALARS  # length of `Tally.sums`
_COMPONENT_TRIANGLES = 30  # minimum size of a component in voxels of VOXEL_M


class Limits(NamedTuple):
    """Limits of the triangles that a mesh keeps; see :meth:`Map.mesh`."""

    min_confidence: float | None  # None: the one of the highest expected F-score
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
    ) -> "Limits":
        """Check the arguments of :meth:`Map.mesh` and fill in defaults."""
        if min_confidence is not None:
            min_confidence = number(min_confidence, "min_confidence")
        check(0 <= (min_confidence or 0) <= 1, f"min_confidence must be in [0, 1], not {min_confidence}")
        max_uncertainty = number(math.inf if max_uncertainty is None else max_uncertainty, "max_uncertainty")
        check(max_uncertainty >= 0, f"max_uncertainty must be at least 0, not {max_uncertainty}")
        if min_component_triangles is None:
            # Fewer in larger voxels, whose triangles have more area.
            min_component_triangles = round(_COMPONENT_TRIANGLES * min(1.0, VOXEL_M / voxel_m))
        components = whole_number(min_component_triangles, "min_component_triangles", 0)
        return cls(min_confidence, max_uncertainty, components)

    def met(self, threshold: float, confidence: Floats32, uncertainty_m: Floats32) -> Bools:
        """Return a mask (V,) of vertices within the limits at a confidence threshold. NaN exceeds any finite uncertainty."""
        certain = np.nan_to_num(uncertainty_m, nan=np.inf) <= self.max_uncertainty
        return certain & (confidence >= threshold)


@dataclass(frozen=True)
class Threshold:
    """Confidence threshold of a mesh, and its expected quality. The names are those in the ``metadata`` of a mesh."""

    min_confidence: float  # in [0, 1]; surface below it is left out
    expected_precision: float  # expected true share of the kept area; 0 if nothing is kept
    coverage_of_observed: float  # expected share of the surface with returns that is kept; 0 if there is none
    whole_precision: float  # the same two if all surface were kept, regardless of its confidence
    whole_coverage_of_observed: float

    @classmethod
    def of_mesh(cls, metadata: Mapping[str, Any]) -> "Threshold":
        return cls(**{name: metadata[name] for name in cls.__dataclass_fields__})

    def __str__(self) -> str:
        return (
            f"cut at a confidence of {self.min_confidence:.2f}: an expected {100 * self.expected_precision:.0f} % of it is true "
            f"surface, which covers {100 * self.coverage_of_observed:.0f} % of the surface with returns; uncut, they are "
            f"{100 * self.whole_precision:.0f} and {100 * self.whole_coverage_of_observed:.0f} %"
        )


@dataclass(frozen=True)
class Tally:
    """Area of a map's surface by confidence. Sums are additive over parts of a map, such as tiles."""

    # (3 B + 3,) in each of B equal bins of the confidence from 0 to 1: area, m²; expected true area, m²; true surface newly
    # covered as the threshold falls, up to a constant factor. Then expected true surface, m²: regardless of the accuracy of
    # its position; with a single hit (one scan in one cell); with two hits.
    sums: Floats

    @classmethod
    def of(
        cls, area_m2: Floats, confidence: Floats, covering: Floats, reach: Floats, hits: Floats
    ) -> "Tally":
        """Build from the vertices of a surface: areas by the core's ``vertex_areas``, and results of :mod:`queries`, (V,) each."""
        true_m2 = confidence * area_m2
        bins = np.minimum((confidence * _BINS).astype(np.int64), _BINS - 1)
        existing_m2 = np.divide(true_m2, reach, out=np.zeros_like(true_m2), where=true_m2 > 0)
        scans = np.round(hits)

        sums = [np.bincount(bins, values, _BINS) for values in (area_m2, true_m2, covering * area_m2)]
        scalars = (np.minimum(existing_m2, area_m2), true_m2[scans == 1], true_m2[scans == 2])
        return cls(np.concatenate([*sums, [values.sum() for values in scalars]]))

    def threshold(self, min_confidence: float | None = None) -> Threshold:
        """Return the threshold of the highest expected F-score, or the expected quality at a given confidence."""
        of_bins = self.sums[:-_SCALARS].reshape(-1, _BINS)
        kept_m2, true_m2, covering = (np.cumsum(values[::-1])[::-1] for values in of_bins)
        precision = np.divide(true_m2, kept_m2, out=np.zeros_like(true_m2), where=kept_m2 > 0)
        coverage = covering / covering[0] if covering[0] > 0 else covering
        if min_confidence is None:
            total = precision + self.reachable * coverage
            # Up to a factor of twice the reachable share, which is constant: if nothing is reachable, all is kept.
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
        """Share of the observed surface that can be covered: it has returns, and its position is accurate enough."""
        # Of the surface that these scans could have hit, at least once² / (2 · twice) has no return: Chao's estimator of
        # unseen species. Surface that no ray reaches leaves no trace in these counts.
        true_m2 = float(self.sums[_BINS : 2 * _BINS].sum())
        existing_m2, once_m2, twice_m2 = self.sums[-_SCALARS:].tolist()
        if true_m2 == 0 or (once_m2 > 0 and twice_m2 == 0):
            return 0.0
        unseen_m2 = once_m2**2 / (2 * twice_m2) if once_m2 > 0 else 0.0
        return true_m2 / (true_m2 + unseen_m2) * true_m2 / existing_m2
