# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf check``: what is wrong with scans and poses, before a fit."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING, Any

from radarsdf.cli.options import add_config_options, config_of
from radarsdf.cli.saying import complain, say
from radarsdf.cli.scans_in import add_scans, scans_of, words_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from radarsdf.io.sequence import Scans


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser)
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    add_config_options(parser)


def run(options: argparse.Namespace) -> int:
    """Print the findings, the worst first, and the command to run next. The status is 1 if one is an error."""
    import dataclasses
    import json

    from radarsdf import check

    config = config_of(options)
    scans = scans_of(options)
    points = scans.points  # first: it reads all there is, in one pass
    findings = check(
        points,
        scans.poses,
        scans.intensities,
        doppler_mps=scans.doppler_mps,
        times_s=scans.times_s,
        config=config,
    )
    failed = any(finding.severity == "error" for finding in findings)
    target = shlex.quote(str(options.scans.with_suffix(".safetensors")))
    words = words_of(options)
    following = f"radarsdf check {words}" if failed else f"radarsdf fit {words} -o {target}"
    if options.json:
        say(json.dumps({"findings": [dataclasses.asdict(f) for f in findings], "next": following}, indent=2))
    else:
        for finding in findings:
            say(str(finding))
        say(f"next: {'mend the errors, then ' if failed else ''}{following}")
    return int(failed)


def warn_or_refuse(scans: Scans, intensities: list[NDArray[Any]] | None) -> None:
    """Say what the cheap checks find in scans, before they are fitted with these intensities.

    Raises
    ------
    ValueError
        If a map of them would be nonsense.
    """
    from radarsdf.checking.check import check_cheaply

    for finding in check_cheaply(scans.points, scans.poses, intensities):
        if finding.severity == "error":
            msg = f"{finding.name}: {finding.evidence} {finding.mend} --no-check fits the scans as they are"
            raise ValueError(msg)
        if finding.severity == "warning":
            complain(f"radarsdf fit: {finding}")
