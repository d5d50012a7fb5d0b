# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the given poses say: from each scan to the next, but for noise and a bias that all steps have in common."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.poses.rigid import Floats, skew, steps

_LEAST_SPAN = 0.1  # of a step, in median steps: two scans at the same time may still differ
_LEAST_M, _LEAST_RAD = 1e-5, 1e-6  # deviations to divide by: no radar tells less


@dataclass(frozen=True)
class Motion:
    """The given motions between neighbouring scans, with their errors."""

    steps: Floats
    """(F - 1, 4, 4) as given."""
    bias: Floats
    """(6,) that each step has too much: translation, m, rotation vector, rad, in the frame of the sensor."""
    sigma_m: float
    """Standard deviation of each component of a step's translation."""
    sigma_rad: float
    """Likewise of its rotation."""
    spans: Floats
    """(F - 1,) duration of each step over the median. Biases grow with it, and variances: errors of steps add up."""

    @classmethod
    def of(cls, poses: Floats, sigma_m: float, sigma_rad: float, times_s: Floats | None = None) -> Motion:
        """Of the given poses (F, 4, 4), at `times_s` (F,). None: they are equally far apart."""
        spans = np.ones(len(poses) - 1)
        if times_s is not None:
            durations = np.maximum(np.diff(times_s), 0.0)
            median = float(np.median(durations))
            spans = np.maximum(durations / median, _LEAST_SPAN) if median > 0 else spans
        return cls(steps(poses), np.zeros(6), max(sigma_m, _LEAST_M), max(sigma_rad, _LEAST_RAD), spans)

    def errors(self, poses: Floats) -> Floats:
        """(F - 1, 6) of the given steps, if `poses` (F, 4, 4) are right: translations, m, and rotation vectors, rad."""
        found, given = steps(poses), self.steps
        turns = np.einsum("fji,fjk->fik", given[:, :3, :3], found[:, :3, :3])
        return np.concatenate([found[:, :3, 3] - given[:, :3, 3], Rotation.from_matrix(turns).as_rotvec()], 1)

    @staticmethod
    def _jacobians(poses: Floats) -> tuple[Floats, Floats]:
        """(F - 1, 6, 6) each: of a step's errors by the increments of its first and its second pose."""
        first, second = np.zeros((2, len(poses) - 1, 6, 6))
        back = poses[:-1, :3, :3].transpose(0, 2, 1)
        first[:, :3, :3], second[:, :3, :3] = -back, back
        first[:, :3, 3:] = np.einsum("fij,fjk->fik", back, skew(poses[1:, :3, 3] - poses[:-1, :3, 3]))
        turned_back = poses[1:, :3, :3].transpose(0, 2, 1)
        first[:, 3:, 3:], second[:, 3:, 3:] = -turned_back, turned_back
        return first, second

    def prior(self, poses: Floats) -> tuple[Floats, Floats, Floats]:
        """Of increments of `poses` (F, 4, 4): blocks on the diagonal (F, 6, 6) and below it (F - 1, 6, 6), and the gradient (F, 6)."""
        information = np.repeat([self.sigma_m**-2, self.sigma_rad**-2], 3) / self.spans[:, None]
        first, second = self._jacobians(poses)
        errors = (self.errors(poses) - self.bias * self.spans[:, None]) * information
        diagonal, gradient = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
        for rows, jacobian in ((slice(None, -1), first), (slice(1, None), second)):
            diagonal[rows] += np.einsum("fki,fk,fkj->fij", jacobian, information, jacobian)
            gradient[rows] += np.einsum("fki,fk->fi", jacobian, errors)
        return diagonal, np.einsum("fki,fk,fkj->fij", second, information, first), gradient

    def learnt(self, poses: Floats, diagonal: Floats, below: Floats, known: tuple[bool, bool]) -> Motion:
        """With the bias and the deviations that `poses` show, whose covariance has blocks (F, 6, 6) and (F - 1, 6, 6).

        A step of expectation maximisation (Dempster et al. 1977): the square of an error is that of its estimate and its
        variance. `known`: whether the deviations of translations, and of rotations, stay as they are.
        """
        first, second = self._jacobians(poses)
        crossed = np.einsum("fai,fij,faj->fa", second, below, first)
        variances = (
            np.einsum("fai,fij,faj->fa", first, diagonal[:-1], first)
            + np.einsum("fai,fij,faj->fa", second, diagonal[1:], second)
            + 2 * crossed
        )
        errors = self.errors(poses)
        bias = errors.sum(axis=0) / self.spans.sum()
        spans = self.spans[:, None]
        squares = (((errors - bias * spans) ** 2 + variances) / spans).mean(axis=0)
        sigma_m, sigma_rad = np.sqrt([squares[:3].mean(), squares[3:].mean()]).tolist()
        return dataclasses.replace(
            self,
            bias=bias,
            sigma_m=self.sigma_m if known[0] else max(sigma_m, _LEAST_M),
            sigma_rad=self.sigma_rad if known[1] else max(sigma_rad, _LEAST_RAD),
        )
