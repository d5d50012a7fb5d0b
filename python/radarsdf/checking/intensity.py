# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the intensities tell: whether they are measured at all, their steps, where they are clipped, an offset."""

from __future__ import annotations

import numpy as np

from radarsdf.checking.finding import Finding
from radarsdf.checking.recording import FloatArray, Recording

_SOME, _MANY = 0.005, 0.05  # share of the returns at the highest value
_ABOVE_NEXT = 5.0  # times the share at each of the next values
_FEW_VALUES = 1000  # different ones. More have no steps that matter
_RCS_OFFSET = 128  # of radar cross sections in dBsm, to put them into a byte
_LEAST_RETURNS = 100


def check_intensities(recording: Recording) -> list[Finding]:
    """Tells what is worth knowing of the intensities."""
    if recording.intensities is None:
        return []
    scans = [np.asarray(recording.intensities[i], np.float64) for i in recording.some_scans()]
    values = np.concatenate(scans)
    finite = np.isfinite(values)
    if not finite.all():
        return [
            Finding(
                "intensity_not_finite",
                "error",
                f"{1 - finite.mean():.2%} of the intensities are not finite.",
                "Leave out these returns, or fit without intensities.",
            )
        ]
    if values.min() == values.max():
        return [
            Finding(
                "intensity_constant",
                "error",
                f"All intensities are {values[0]:g}.",
                "Pass another field, or fit without intensities: the sensor does not measure this one.",
            )
        ]
    larger = [scan for scan in scans if len(scan) > 1]
    constant = [scan.min() == scan.max() for scan in larger]
    if larger and np.mean(constant) > 0.5:
        return [
            Finding(
                "intensity_constant_in_scans",
                "warning",
                f"In {np.mean(constant):.0%} of the scans all returns have the same intensity.",
                "Look for a fault of the driver, or fit without intensities.",
            )
        ]
    return _values(values) if len(values) >= _LEAST_RETURNS else []


def _values(values: FloatArray) -> list[Finding]:
    """Findings about steps, an offset, and values that pile up at the end of the scale."""
    found = []
    levels, counts = np.unique(values, return_counts=True)
    shares = counts / len(values)
    if len(levels) < _FEW_VALUES:
        step = float(np.median(np.diff(levels)))
        found.append(
            Finding(
                "intensity_steps",
                "note",
                f"Intensities are {levels[0]:g} to {levels[-1]:g}, in steps of {step:.3g}.",
                "Nothing needs to be done.",
            )
        )
        low, middle = np.percentile(values, [5, 50])
        whole = bool((values == np.round(values)).all())
        if whole and levels[0] >= 0 and levels[-1] <= 255 and low > 64 and abs(middle - _RCS_OFFSET) < 40:
            found.append(
                Finding(
                    "intensity_offset",
                    "note",
                    f"Intensities are whole numbers, half of them above {middle:g}: they look like radar cross sections in "
                    f"dBsm with {_RCS_OFFSET} added.",
                    f"Subtract {_RCS_OFFSET} for dBsm; a fit does not need it.",
                )
            )
    if len(levels) > 4 and shares[-1] > max(_SOME, _ABOVE_NEXT * float(shares[-4:-1].mean())):
        found.append(
            Finding(
                "intensity_clipped",
                "warning" if shares[-1] > _MANY else "note",
                f"{shares[-1]:.1%} of the intensities have the highest value, {levels[-1]:g}.",
                "Lower the gain of the sensor, or read a field that is not clipped.",
            )
        )
    return found
