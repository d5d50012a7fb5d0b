# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is measured of the motion from each scan to the next, but for noise and a bias that all steps have in common."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.poses.rigid import Floats, skew, steps

_LEAST_SPAN = 0.1  # of a step, in median steps: two scans at the same time may still differ
_LEAST_M, _LEAST_RAD = 1e-5, 1e-6  # deviations to divide by: no radar tells less


@dataclass(frozen=True)
class Motion:
    """Motions between neighbouring scans as one source has them, with its errors: of given poses, of Doppler, of a gyroscope."""

    steps: Floats
    """(F - 1, 4, 4) as measured."""
    bias: Floats
    """(6,) that each step has too much: translation, m, rotation vector, rad, in the frame of the sensor."""
    variances: Floats
    """(2,) of each component of a step's translation, m², and of its rotation, rad², where its share is 1."""
    shares: Floats
    """(F - 1, 6) by which each step's variances differ from these. Infinite: the source does not tell this component."""
    known: tuple[bool, bool]
    """Whether the variances of translations, and of rotations, stay as they are."""
    spans: Floats
    """(F - 1,) duration of each step over the median. Biases grow with it."""
    bias_sigma: Floats = field(default_factory=lambda: np.zeros(6), kw_only=True)
    """(6,) deviation of the part of the bias that no measurement of this source can find."""
    least_variances: Floats = field(default_factory=lambda: np.zeros(2), kw_only=True)
    """(2,) as `variances`, at least, where the covariance is computed."""

    @classmethod
    def of(
        cls,
        poses: Floats,
        sigma_m: float,
        sigma_rad: float,
        times_s: Floats | None = None,
        known: tuple[bool, bool] = (False, False),
    ) -> Motion:
        """Of given poses (F, 4, 4), at `times_s` (F,). None: they are equally far apart. Errors of steps add up: variances grow
        with time."""
        spans = spans_of(times_s, len(poses))
        shares = np.repeat(spans[:, None], 6, axis=1)
        variances = np.square([max(sigma_m, _LEAST_M), max(sigma_rad, _LEAST_RAD)])
        return cls(steps(poses), np.zeros(6), variances, shares, known, spans)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of each component of a step's translation."""
        return float(np.sqrt(self.variances[0]))

    @property
    def sigma_rad(self) -> float:
        """Likewise of its rotation."""
        return float(np.sqrt(self.variances[1]))

    def with_turns(self, turns: Floats) -> Motion:
        """With rotation vectors (F - 1, 3), rad, that another source measured."""
        measured = self.steps.copy()
        measured[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
        return dataclasses.replace(self, steps=measured)

    def rotations_only(self) -> Motion:
        """Without the translations."""
        shares = self.shares.copy()
        shares[:, :3] = np.inf
        return dataclasses.replace(self, shares=shares)

    def as_evidence(self) -> Motion:
        """With the variances that the covariance of poses is computed with.

        Steps that were tracked by the same returns have the errors of these. As independent measurements, they would halve the
        deviations.
        """
        return dataclasses.replace(self, variances=np.maximum(self.variances, self.least_variances))

    def at(self, poses: Floats) -> Motion:  # noqa: ARG002 - for motions by Doppler
        """As measured by a sensor with these poses (F, 4, 4). Most measurements are the same for all."""
        return self

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
        information = 1 / (np.repeat(self.variances, 3) * self.shares)
        first, second = self._jacobians(poses)
        errors = (self.errors(poses) - self.bias * self.spans[:, None]) * information
        diagonal, gradient = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
        for rows, jacobian in ((slice(None, -1), first), (slice(1, None), second)):
            diagonal[rows] += np.einsum("fki,fk,fkj->fij", jacobian, information, jacobian)
            gradient[rows] += np.einsum("fki,fk->fi", jacobian, errors)
        return diagonal, np.einsum("fki,fk,fkj->fij", second, information, first), gradient

    def by_bias(self, poses: Floats) -> tuple[Floats, Floats]:
        """By components of the bias that are uncertain, in their deviations: derivatives of the gradient (K, F, 6), information (K,)."""
        rows = np.flatnonzero(self.bias_sigma)
        weights = self.spans[:, None] / (np.repeat(self.variances, 3) * self.shares) * self.bias_sigma
        found = np.zeros((len(rows), len(poses), 6))
        for scans, jacobian in zip((slice(None, -1), slice(1, None)), self._jacobians(poses), strict=True):
            found[:, scans] -= np.einsum("fki,fk->kfi", jacobian[:, rows], weights[:, rows])
        return found, (weights * self.spans[:, None] * self.bias_sigma).sum(axis=0)[rows]

    def learnt(self, poses: Floats, before: Floats, diagonal: Floats, below: Floats) -> Motion:
        """With the bias and the deviations that `poses` show.

        Their covariance has blocks (F, 6, 6) and (F - 1, 6, 6), of increments of the poses `before`. Where the whole is, these
        hardly know: only there does it cost nothing, and at other poses, it would seem errors of steps of half a metre.
        A step of expectation maximisation (Dempster et al. 1977): the square of an error is that of its estimate and its
        variance.
        """
        first, second = self._jacobians(before)
        crossed = np.einsum("fai,fij,faj->fa", second, below, first)
        variances = (
            np.einsum("fai,fij,faj->fa", first, diagonal[:-1], first)
            + np.einsum("fai,fij,faj->fa", second, diagonal[1:], second)
            + 2 * crossed
        )
        errors, spans = self.errors(poses), self.spans[:, None]
        told = np.isfinite(self.shares)
        weights = 1 / self.shares
        bias = (weights * spans * errors).sum(axis=0) / np.maximum((weights * spans**2).sum(axis=0), 1e-30)
        bias *= self._told(bias, (weights * variances).sum(axis=0) / np.maximum(told.sum(axis=0), 1))
        squares = ((errors - bias * spans) ** 2 + variances) * weights
        floors, found = (_LEAST_M**2, _LEAST_RAD**2), self.variances.copy()
        for k, rows in enumerate((slice(0, 3), slice(3, 6))):
            if not self.known[k] and told[:, rows].any():
                found[k] = max(squares[:, rows].sum() / told[:, rows].sum(), floors[k])
        return dataclasses.replace(self, bias=bias, variances=found)

    def _told(self, bias: Floats, left: Floats) -> Floats:
        """(6,) share of a bias (6,) that is believed, if returns and steps together leave a variance `left` (6,) of a step.

        The returns alone leave more. Where that is more than the bias, along a corridor say, it would follow the poses, and
        these the bias, for ever: a straight corridor was drawn together by 3 cm a step.
        """
        before = np.repeat(self.variances, 3)
        gained = bias**2 * np.maximum(before - left, 0.0)
        found: Floats = gained / np.maximum(gained + left * before, 1e-30)
        return found


def unsteadiness(poses: Floats, times_s: Floats | None) -> tuple[float, float]:
    """Deviation by which steps of poses (F, 4, 4) differ from the one before, as if it were noise: m, rad.

    Errors of poses that are repeated, or from another clock, are as large as the steps. An estimate that begins with less takes
    returns that are so far off for wrong ones.
    """
    if len(poses) < 3:
        return 0.0, 0.0
    between, spans = steps(poses), spans_of(times_s, len(poses))
    rates = (
        np.concatenate([between[:, :3, 3], Rotation.from_matrix(between[:, :3, :3]).as_rotvec()], 1)
        / spans[:, None]
    )
    squares = np.diff(rates, axis=0) ** 2 / (1 / spans[1:] + 1 / spans[:-1])[:, None]
    sigma_m, sigma_rad = np.sqrt(np.median(squares.reshape(-1, 2, 3).mean(axis=2), axis=0)).tolist()
    return sigma_m, sigma_rad


def spans_of(times_s: Floats | None, num_scans: int) -> Floats:
    """(F - 1,) durations of steps over the median. Without times, all are alike."""
    spans = np.ones(num_scans - 1)
    if times_s is None:
        return spans
    durations = np.maximum(np.diff(times_s), 0.0)
    median = float(np.median(durations)) if len(durations) else 0.0
    return np.maximum(durations / median, _LEAST_SPAN) if median > 0 else spans
