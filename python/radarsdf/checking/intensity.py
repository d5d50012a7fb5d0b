# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks of the intensities: whether they are measured at all, outliers, steps, an offset, clipping."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from radarsdf.checking.recording import Finding, FloatArray, Recording
from radarsdf.returns.intensities import Plausible

_SOME, _MANY = 0.005, 0.05  # share of the returns at the highest value
_ABOVE_NEXT = 5.0  # times the share at each of the next values
_FEW_VALUES = 1000  # different ones. More have no steps that matter
_RCS_OFFSET = 128  # of radar cross sections in dBsm, to put them into a byte
_LEAST_RETURNS = 100
_NAMED = 3  # sentinels in a message


def check_intensities(recording: Recording) -> Iterator[Finding]:
    """What is worth knowing of the intensities."""
    if recording.intensities is None:
        return
    whole = np.concatenate(recording.intensities)  # one value in any scan can stretch the scale of all
    finite = np.isfinite(whole)
    if not finite.all():
        some = finite.any()
        yield Finding(
            "intensity_not_finite",
            "note" if some else "error",
            f"{1 - finite.mean():.2%} of the intensities are not finite.",
            "Nothing needs to be done: a fit leaves them out of the reflectance."
            if some
            else "Fit without intensities.",
        )
        whole = whole[finite]
    if not len(whole):
        return
    plausible = Plausible.of(whole)
    yield from _outliers(whole, plausible)
    scans = [np.asarray(recording.intensities[i], np.float64) for i in recording.some_scans()]
    scans = [scan[np.isfinite(scan)] for scan in scans]
    scans = [scan[plausible.holds(scan)] for scan in scans]
    values = np.concatenate(scans)
    larger = [scan for scan in scans if len(scan) > 1]
    constant = float(np.mean([scan.min() == scan.max() for scan in larger])) if larger else 0.0
    if len(values) == 0:
        return
    if values.min() == values.max():
        yield Finding(
            "intensity_constant",
            "error",
            f"All intensities are {values[0]:g}.",
            "Pass another field, or fit without intensities: the sensor does not measure this one.",
        )
    elif constant > 0.5:
        yield Finding(
            "intensity_constant_in_scans",
            "warning",
            f"In {constant:.0%} of the scans all returns have the same intensity.",
            "Look for a fault of the driver, or fit without intensities.",
        )
    elif len(values) >= _LEAST_RETURNS:
        yield from _scale(values)


def _outliers(whole: FloatArray, plausible: Plausible) -> Iterator[Finding]:
    """Intensities that are not plausible: repeated ones stand for something else, single ones are faults."""
    held = plausible.holds(whole)
    outliers, usual = whole[~held], whole[held]
    if not len(outliers):
        return
    others = f"far from all others, which are {usual.min():g} to {usual.max():g}"
    left_out = "A fit leaves them out of the reflectance, and keeps these returns in the surface."
    levels, counts = np.unique(outliers, return_counts=True)
    repeated = np.flatnonzero(counts > 1)
    if len(repeated):
        most = repeated[np.argsort(-counts[repeated], kind="stable")]
        named = ", ".join(f"{levels[i]:g}" for i in most[:_NAMED]) + ", …" * (len(most) > _NAMED)
        count = int(counts[repeated].sum())
        yield Finding(
            "intensity_sentinel",
            "warning",
            f"{count} of {len(whole)} intensities ({count / len(whole):.2g}) are {named}, {others}.",
            f"Look up in the driver what {named} stands for: no measurement is likely. {left_out}",
        )
    if len(single := levels[counts == 1]):
        farthest = single[np.argmax(np.abs(single - np.median(usual)))]
        yield Finding(
            "intensity_wild",
            "warning",
            f"{len(single)} of {len(whole)} intensities are wild, such as {farthest:g}: {others}.",
            f"Look for a fault of the driver or of the units: decibels have no such tails. {left_out}",
        )


def _scale(values: FloatArray) -> Iterator[Finding]:
    """Steps, an offset, and values that pile up at the end of the scale."""
    levels, counts = np.unique(values, return_counts=True)
    shares = counts / len(values)
    low, middle = np.percentile(values, [5, 50])
    few = len(levels) < _FEW_VALUES
    if few:
        yield Finding(
            "intensity_steps",
            "note",
            f"Intensities are {levels[0]:g} to {levels[-1]:g}, in steps of {np.median(np.diff(levels)):.3g}.",
            "Nothing needs to be done.",
        )
    bytes_ = (values == np.round(values)).all() and levels[0] >= 0 and levels[-1] <= 255
    if few and bytes_ and low > 64 and abs(middle - _RCS_OFFSET) < 40:
        yield Finding(
            "intensity_offset",
            "note",
            f"Intensities are whole numbers, half of them above {middle:g}: they look like radar cross sections in "
            f"dBsm with {_RCS_OFFSET} added.",
            f"Subtract {_RCS_OFFSET} for dBsm; a fit does not need it.",
        )
    if len(levels) > 4 and shares[-1] > max(_SOME, _ABOVE_NEXT * float(shares[-4:-1].mean())):
        yield Finding(
            "intensity_clipped",
            "warning" if shares[-1] > _MANY else "note",
            f"{shares[-1]:.1%} of the intensities have the highest value, {levels[-1]:g}.",
            "Lower the gain of the sensor, or read a field that is not clipped.",
        )
