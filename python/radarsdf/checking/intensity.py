"""Checks of the intensities: missing measurements, outliers, quantisation, an offset, clipping."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checking.recording import Finding, some_scans
from radarsdf.returns.intensities import Plausible
from radarsdf.scans import Scans

_SOME, _MANY = 0.005, 0.05  # shares of returns at the highest value for a note and a warning
_ABOVE_NEXT = 5.0  # ratio to the share at each of the next values
_FEW_VALUES = 1000  # distinct values: with more, quantisation does not matter
_RCS_OFFSET = 128  # added to radar cross sections in dBsm to store them in a byte
_LEAST_RETURNS = 100
_NAMED = 3  # largest number of values in a message


def check_intensities(recording: Scans) -> Iterator[Finding]:
    """Check the intensities."""
    if recording.intensities is None:
        return
    whole = np.concatenate(recording.intensities)  # one value in any scan can stretch the common scale
    finite = np.isfinite(whole)
    if not finite.all():
        evidence = f"{1 - finite.mean():.2%} of the intensities are not finite."
        yield Finding("intensity_not_finite", "note" if finite.any() else "error", evidence)
        whole = whole[finite]
    if not len(whole):
        return
    plausible = Plausible.of(whole)
    held = plausible.holds(whole)
    if not held.all():
        yield from _outliers(whole[~held], whole[held])
    scans = [np.asarray(recording.intensities[i], np.float64) for i in some_scans(recording)]
    scans = [scan[np.isfinite(scan)] for scan in scans]
    scans = [scan[plausible.holds(scan)] for scan in scans]
    values = np.concatenate(scans)
    if len(values) == 0:
        return
    constant = float(np.mean([scan.min() == scan.max() for scan in scans if len(scan) > 1] or [False]))
    if values.min() == values.max():
        yield Finding("intensity_constant", "error", f"All intensities are {values[0]:g}.")
    elif constant > 0.5:
        evidence = f"In {constant:.0%} of the scans all returns have the same intensity."
        yield Finding("intensity_constant_in_scans", "warning", evidence)
    elif len(values) >= _LEAST_RETURNS:
        yield from _scale(values)


def _outliers(outliers: Floats, usual: Floats) -> Iterator[Finding]:
    """Report outliers: repeated values mark missing measurements, single ones are faults."""
    levels, counts = np.unique(outliers, return_counts=True)
    total = len(outliers) + len(usual)
    for name, chosen in (("intensity_sentinel", counts > 1), ("intensity_outliers", counts == 1)):
        if chosen.any():
            most = levels[chosen][np.argsort(-counts[chosen], kind="stable")]
            named = ", ".join(f"{level:g}" for level in most[:_NAMED]) + ", …" * (len(most) > _NAMED)
            evidence = (
                f"{counts[chosen].sum()} of {total} intensities are {named}, far from the others, which are {usual.min():g} to "
                f"{usual.max():g}."
            )
            yield Finding(name, "warning", evidence)


def _scale(values: Floats) -> Iterator[Finding]:
    """Report quantisation, an offset, and clipping at the end of the scale."""
    levels, counts = np.unique(values, return_counts=True)
    shares = counts / len(values)
    low, middle = np.percentile(values, [5, 50])
    few = len(levels) < _FEW_VALUES
    if few:
        step = np.median(np.diff(levels))
        evidence = f"Intensities are {levels[0]:g} to {levels[-1]:g}, in steps of {step:.3g}."
        yield Finding("intensity_steps", "note", evidence)
    bytes_ = (values == np.round(values)).all() and levels[0] >= 0 and levels[-1] <= 255
    if few and bytes_ and low > 64 and abs(middle - _RCS_OFFSET) < 40:
        evidence = (
            f"Intensities are whole numbers with the median {middle:g}, like dBsm with {_RCS_OFFSET} added."
        )
        yield Finding("intensity_offset", "note", evidence)
    if len(levels) > 4 and shares[-1] > max(_SOME, _ABOVE_NEXT * float(shares[-4:-1].mean())):
        evidence = f"{shares[-1]:.1%} of the intensities have the highest value, {levels[-1]:g}."
        yield Finding("intensity_clipped", "warning" if shares[-1] > _MANY else "note", evidence)
