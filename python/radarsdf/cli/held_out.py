# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensity errors on scans that a fit left out. This module imports NumPy: import it only where a command runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from radarsdf.evaluation import KNNIntensity, format_metrics, intensity_metrics
from radarsdf.map.map import Map
from radarsdf.returns.movers import rays_as_measured
from radarsdf.tiles.tiled_map import predicted

if TYPE_CHECKING:
    from radarsdf.cli.results import Results
    from radarsdf.io.scans import Scans


def add_intensity_errors(results: Results, radar_map: Map, test: Scans, train: Scans) -> None:
    """Add the errors of a map, and of a kNN baseline that is as good as these scans allow; nothing if map or scans have no intensities.

    Parameters
    ----------
    results
        Where they go.
    radar_map
        The map.
    test
        The scans that the fit left out.
    train
        The scans that the fit used. The baseline predicts from them, and chooses its settings on them.
    """
    if not radar_map.has_intensity or test.intensities is None:
        return
    tested, known = (rays_as_measured(scans, radar_map.config) for scans in (test, train))
    given = len(tested)
    tested, known = (rays.select(rays.with_intensity) for rays in (tested, known))
    if len(tested) < given:
        results.add(
            f"{given - len(tested)} of {given} held-out intensities cannot belong to the others, and are not compared",
            wild_intensities=given - len(tested),
        )
        given = len(tested)
    tested, found = predicted(radar_map, tested)
    if len(tested) < given:
        results.add(
            f"{given - len(tested)} of {given} held-out returns are in no tile",
            in_no_tile=given - len(tested),
        )
    (x, sensors), measured = tested.in_world(), tested.intensities
    assert measured is not None
    assert known.intensities is not None
    errors = intensity_metrics(found, measured)
    results.add("held-out " + format_metrics(errors), held_out=errors)
    knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
    metrics = intensity_metrics(knn.predict(x, sensors), measured)
    results.add(
        f"kNN      {format_metrics(metrics)}, {knn.k} of {knn.candidates} neighbours",
        knn=metrics | {"neighbours": knn.k, "candidates": knn.candidates},
    )
