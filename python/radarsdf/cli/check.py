# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf check``: what is wrong with scans and poses, before a fit."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.map_in import MAP_SUFFIX
from radarsdf.cli.options import add_config_options, add_json, config_of, config_words
from radarsdf.cli.results import Results
from radarsdf.cli.saying import complain
from radarsdf.cli.scans_in import add_scans, scans_of, words_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from radarsdf.io.scans import Scans


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_scans(parser)
    add_config_options(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Print the findings, the worst first, and the command to run next. The status is 1 if one is an error."""
    import dataclasses

    from radarsdf import check

    config = config_of(options)
    findings = check(scans_of(options), config=config)
    failed = any(finding.severity == "error" for finding in findings)
    # Here, and not beside the data: those may be on a disk that nobody should write to.
    target = shlex.quote(Path(os.path.abspath(options.scans)).stem + MAP_SUFFIX)  # noqa: PTH100 - links keep their names
    words = shlex.join([*words_of(options), *config_words(options)])
    following = f"radarsdf check {words}" if failed else f"radarsdf fit {words} -o {target}"
    results = Results(options)
    results.add(findings=[dataclasses.asdict(finding) for finding in findings], next=following)
    for finding in findings:
        results.add(str(finding))
    results.add(f"next: {'mend the errors, then ' if failed else ''}{following}")
    results.end()
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
