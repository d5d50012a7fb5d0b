# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The sections of errors against ground truth, and of the uncertainty that the map states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf.evaluation import surface_metrics, uncertainty_metrics
from radarsdf.report import plots
from radarsdf.report.page import Section, Sentence, grid, image, note, paragraph, table
from radarsdf.report.subject import Subject
from radarsdf.report.surface import colored, picture
from radarsdf.threads import resolve_num_threads

_SAMPLES = 1_000_000
_TRUE_M = (
    0.4  # a vertex nearer to the truth than this is a surface with an error; a farther one is no surface
)
_LEAST_POINTS = 100
# One standard error holds 68 % of errors. This far from it, some tenth of the surface is judged wrongly.
_LEAST_SHARE, _MOST_SHARE = 0.58, 0.78
_POINTS = {
    "lidar": ("lidar point", "lidar points"),
    "simulated": ("point of the simulated truth", "points of the simulated truth"),
    "given": ("point of the given truth", "points of the given truth"),
}
"""A point of the truth, and many, by where it comes from."""

_Floats = NDArray[np.float64]


def truth_section(subject: Subject) -> tuple[Section, list[tuple[str, str]], list[Sentence]]:
    """Errors of the surface, the most important one for the top of the page, and a sentence for the conclusion."""
    anchor, title = "errors", "Errors against ground truth"
    truth, mesh = subject.ground_truth, subject.mesh
    if truth is None or len(mesh.faces) == 0:
        why = "The scans come without a truth." if truth is None else "There is no surface."
        if subject.scans is None:
            why = "This report was made without scans, which may come with a truth."
        sentence = Sentence("note", "Surface", f"How right it is was not measured. {why}")
        return Section(anchor, title, [paragraph(f"Not measured. {why}")]), [], [sentence]
    one, many = _POINTS[subject.truth_kind]
    m = surface_metrics(mesh, truth, box=subject.box, samples=_SAMPLES)
    accuracy = (
        "–" if m["accuracy_error_m"] is None else f"{100 * m['accuracy_error_m']:.1f}\N{NO-BREAK SPACE}cm"
    )
    rows = [
        (
            "F-score, nothing discarded",
            _percent(m["f_score_all"]),
            "harmonic mean of precision and completion",
        ),
        ("Precision", _percent(m["precision"]), f"surface within {m['threshold_m']:g} m of a {one}"),
        (
            "Completion",
            _percent(m["completion_ratio"]),
            f"{many} within {m['threshold_m']:g} m of the surface",
        ),
        (
            "Outliers",
            _percent(m["outlier_ratio"]),
            f"surface farther than {m['outlier_m']:g} m from any {one}",
        ),
        ("Mean error of the surface", accuracy, "without outliers"),
        (
            "Mean error of completion",
            f"{100 * m['completion_error_m']:.1f}\N{NO-BREAK SPACE}cm",
            f"distances count as at most {m['truncation_m']:g} m",
        ),
    ]
    distance_m = _distances(subject.truth_tree, mesh.vertices)
    shown, _ = subject.shown
    shown_m = distance_m if shown is mesh else _distances(subject.truth_tree, shown.vertices)
    colors, legend = colored(shown_m, "distance to the truth, m", (0.0, _TRUE_M))
    body = [
        table("", ("", "value", "meaning"), rows),
        grid(
            image(
                picture(shown, colors),
                f"The surface coloured by the distance to the nearest {one}.",
                f"Dark is right; yellow is far from every {one}.",
                legend,
            ),
            image(
                plots.cumulative(
                    {
                        "surface to truth": distance_m,
                        "truth to surface": _distances(cKDTree(mesh.vertices), truth),
                    },
                    label="distance, m",
                    most=1.0,
                    mark=m["threshold_m"],
                ),
                f"Shares of surface and of {many} whose distance to the other is below a number of metres.",
                f"Distances from vertex to point and back. The dashed line is at {m['threshold_m']:g} m.",
            ),
        ),
        note(
            f"{m['protocol']}: {m['num_mesh_samples']:,} samples of the surface, {m['num_ground_truth']:,} {many}. "
            + (
                ""
                if subject.box is not None
                else "Everything counts, also where only the radar or only the truth reaches. "
            )
            + "radarsdf eval measures with other samples or in a box."
        ),
    ]
    sentence = Sentence(
        "note",
        "Surface",
        f"Its F-score is {_percent(m['f_score_all'])} with nothing discarded, its mean error {accuracy}, against {many}.",
    )
    return Section(anchor, title, body), [("F-score, all", _percent(m["f_score_all"]))], [sentence]


def uncertainty_section(subject: Subject) -> tuple[Section, list[Sentence]]:
    """The uncertainty of the surface, whether it is right where there is ground truth, and sentences about that."""
    anchor, title = "uncertainty", "Uncertainty"
    mesh = subject.mesh
    if len(mesh.faces) == 0:
        return Section(anchor, title, [paragraph("There is no surface.")]), []
    sigma_m = np.asarray(mesh.vertex_attributes["uncertainty_m"], np.float64)
    confidence = np.asarray(mesh.vertex_attributes["confidence"], np.float64)
    shown, _ = subject.shown
    low, high = np.nanpercentile(sigma_m, [2, 98])
    colors, legend = colored(
        shown.vertex_attributes["uncertainty_m"], "standard error, m", (float(low), float(high))
    )
    figures = [
        image(
            picture(shown, colors),
            "The surface coloured by its uncertainty.",
            "Dark is certain, yellow uncertain.",
            legend,
        ),
        image(
            plots.histogram(sigma_m, label="uncertainty, m", most=float(np.nanpercentile(sigma_m, 99.5))),
            "Histogram of the uncertainty of the surface.",
            "Shares of the surface by uncertainty.",
        ),
    ]
    ranks = (10, 50, 90)
    rows = [
        ("Uncertainty,\N{NO-BREAK SPACE}m", *(f"{x:.3f}" for x in np.nanpercentile(sigma_m, ranks))),
        ("Confidence", *(f"{x:.2f}" for x in np.nanpercentile(confidence, ranks))),
    ]
    body = [
        paragraph(
            "The standard error of the surface's position, which follows from the noise of the returns. The confidence is "
            "the probability that there is a surface."
        ),
        table("", ("", *(f"{rank} % are below" for rank in ranks)), rows),
    ]
    half = f"Half of the surface is known within {np.nanmedian(sigma_m):.3f}\N{NO-BREAK SPACE}m"
    sentence = Sentence(
        "note", "Uncertainty", f"{half}, as the map says; no truth tells whether that is right."
    )
    if subject.ground_truth is not None:
        figure, words, share = _reliability(subject, sigma_m)
        figures += figure
        body.append(note(words))
        if share is not None:
            sentence = Sentence(
                "good" if share >= _LEAST_SHARE else "warning",
                "Uncertainty",
                f"{half}, and {_percent(share)} of its errors are within one standard error, where 68 % are expected: "
                f"{_in_words(share)}.",
            )
    body.insert(2, grid(*figures))
    return Section(anchor, title, body), [sentence]


def _in_words(share: float) -> str:
    """What it means that this share of the errors is within one standard error."""
    if share < _LEAST_SHARE:
        return "the map is surer than it should be; errors of the poses may be larger than it knows"
    return (
        "errors are mostly smaller than the map says" if share > _MOST_SHARE else "errors are as the map says"
    )


def _reliability(subject: Subject, sigma_m: _Floats) -> tuple[list[str], str, float | None]:
    """A plot of the errors over the uncertainties, what else they say, and the share within one standard error."""
    mesh, truth = subject.mesh, subject.ground_truth
    assert truth is not None
    one, _ = _POINTS[subject.truth_kind]
    vertices = np.asarray(mesh.vertices, np.float64)
    distance_m, nearest = subject.truth_tree.query(vertices, workers=resolve_num_threads(0))
    error_m = ((truth[nearest] - vertices) * np.asarray(mesh.vertex_normals)).sum(axis=1)
    error_m[distance_m > _TRUE_M] = np.nan
    if np.count_nonzero(np.isfinite(error_m) & np.isfinite(sigma_m)) < _LEAST_POINTS:
        return [], f"Too little of the surface is near a {one} to compare the uncertainty with errors.", None
    m = uncertainty_metrics(error_m, sigma_m)
    figure = image(
        plots.reliability(m["decile_predicted_m"], m["decile_rmse_m"]),
        "Errors of the surface over the uncertainties predicted for them, in ten bins.",
        "Each point is a tenth of the surface. On the dashed line the map knows its errors.",
    )
    words = (
        f"Errors are distances to the nearest {one} along the normal, of the {_percent(m['num_points'] / len(vertices))} "
        f"of the surface that is within {_TRUE_M:g} m of one. {_percent(m['coverage_68'])} of them are within one standard "
        f"error (68 % would be right), {_percent(m['coverage_95'])} within the interval for 95 %. The noise of the truth "
        "and the gaps between its points count as errors here."
    )
    return [figure], words, float(m["coverage_68"])


def _distances(tree: Any, queries: _Floats) -> _Floats:
    """(N,) distance of each query (N, 3) to the nearest point of a tree, m."""
    distance_m: _Floats = tree.query(queries, workers=resolve_num_threads(0))[0]
    return distance_m


def _percent(share: float) -> str:
    return f"{100 * share:.1f}\N{NO-BREAK SPACE}%"
