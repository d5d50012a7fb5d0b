# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The conclusion: what the figures of the page say, in words, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from radarsdf.report.page import Section, Sentence, items
from radarsdf.report.subject import Subject

# Five real drives of Astyx HiRes2019 and two seeds of each simulated radar have up to 0.141 m, 0.62° and 1.13°.
_USUAL_M, _USUAL_AZIMUTH_DEG, _USUAL_ELEVATION_DEG = 0.15, 0.65, 1.2


def conclusion_section(subject: Subject, others: Sequence[Sentence]) -> Section:
    """What is to be said of scans and map; `others`: what other sections say."""
    sentences = [*_of_noise(subject), _of_scans(subject), *others]
    return Section("conclusion", "Conclusion", [items([*sentences, _next(subject, sentences)])])


def _of_noise(subject: Subject) -> list[Sentence]:
    noise = subject.radar_map.report.get("noise")
    if noise is None:
        return []
    range_m = noise["range_m"]
    azimuth_deg, elevation_deg = np.degrees([noise["azimuth_rad"], noise["elevation_rad"]])
    as_usual = (
        range_m <= _USUAL_M and azimuth_deg <= _USUAL_AZIMUTH_DEG and elevation_deg <= _USUAL_ELEVATION_DEG
    )
    return [
        Sentence(
            "good" if as_usual else "warning",
            "Radar noise",
            f"It is {range_m:.3f}\N{NO-BREAK SPACE}m along the beam, {azimuth_deg:.2f}° in azimuth and {elevation_deg:.2f}° "
            f"in elevation: {'as expected' if as_usual else 'more than expected'}. Other imaging radars have up to "
            f"{_USUAL_M:g}\N{NO-BREAK SPACE}m, {_USUAL_AZIMUTH_DEG:g}° and {_USUAL_ELEVATION_DEG:g}°."
            + ("" if as_usual else " Errors of the poses count as noise, too."),
        )
    ]


def _of_scans(subject: Subject) -> Sentence:
    findings = subject.findings
    if findings is None:
        return Sentence(
            "note", "Scans and poses", "They were not checked: this report was made without scans."
        )
    bad = [finding for finding in findings if finding.severity != "note"]
    if not bad:
        return Sentence(
            "good", "Scans and poses", "The scans agree with each other where the poses put them."
        )
    names = ", ".join(finding.name for finding in bad)
    return Sentence(bad[0].severity, "Scans and poses", f"The check found {names}.")


def _next(subject: Subject, sentences: Sequence[Sentence]) -> Sentence:
    """The one thing that is worth doing."""
    bad = [finding for finding in subject.findings or () if finding.severity != "note"]
    unsure = any(sentence.name == "Uncertainty" and sentence.mark == "warning" for sentence in sentences)
    if bad:
        text = f"{bad[0].mend} Then fit again."
    elif subject.scans is None:
        text = "Give the scans to radarsdf report, too: it then checks them, and compares intensities."
    elif unsure:
        text = "State the errors of the poses, returns.pose_sigma_m and pose_sigma_rad, and fit again."
    elif subject.held_out is None and subject.radar_map.has_intensity:
        text = "Fit and report with --holdout 10, to see how right intensities are on scans that the fit left out."
    else:
        text = "Nothing needs to be mended. radarsdf mesh writes the surface, radarsdf view shows it."
    return Sentence("note", "Next", text)
