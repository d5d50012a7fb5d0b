# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What commands print, as lines and tables for people or one JSON object for programs, and how they keep a map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from radarsdf.cli.app import warn

if TYPE_CHECKING:
    import numpy as np
    import trimesh
    from numpy.typing import NDArray

    from radarsdf import RadarMap
    from radarsdf.io.scans import Scans
    from radarsdf.map.map import Map
    from radarsdf.view.serving import Page


@dataclass(kw_only=True)
class Results:
    """Prints what a command has found; with ``--json``, nothing before :meth:`end`.

    quiet: Show no progress bar.
    json: Print the results as one JSON object, lengths in m; progress and warnings go to standard error.
    """

    quiet: bool = False
    json: bool = False

    def __post_init__(self) -> None:
        self._values: dict[str, Any] = {}
        self._ended = False

    @property
    def progress(self) -> bool | None:
        """The argument `progress` of the library's functions."""
        return False if self.quiet else None

    def add(self, line: str | None = None, **values: Any) -> None:
        """Print a line for people, and keep the same numbers for programs by name; lengths in m, times in s."""
        if line is not None and not self.json:
            typer.echo(line)
        self._values |= values

    def table(self, rows: Iterable[Sequence[str]], headings: Sequence[str] = ()) -> None:
        """Print rows for people. With headings, all columns but the first are aligned to the right."""
        table = [headings, *rows] if headings else list(rows)
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        for first, *others in table:
            aligned = [
                f"{cell:>{width}}" if headings else cell
                for cell, width in zip(others, widths[1:], strict=True)
            ]
            self.add("  ".join([first.ljust(widths[0]), *aligned]))

    def add_threshold(self, metadata: Mapping[str, Any]) -> None:
        """Add the confidence from which on a mesh with this ``metadata`` was kept, and what that costs."""
        from radarsdf.map.threshold import Threshold

        threshold = Threshold.of_mesh(metadata)
        self.add(str(threshold), **threshold.metadata)

    def add_mesh(self, mesh: trimesh.Trimesh, path: Path, origin: NDArray[np.float64] | None) -> None:
        """Add what was written to a file, and where its origin is, if it has one of its own."""
        vertices, triangles = len(mesh.vertices), len(mesh.faces)
        line = f"{vertices} vertices and {triangles} triangles written to {path}"
        self.add(line, vertices=vertices, triangles=triangles, out=path)
        self.add_origin(path, origin)

    def add_origin(self, path: Path, origin: NDArray[np.float64] | None) -> None:
        """Add where the origin of a file is, if it has one of its own."""
        from radarsdf.io.files import origin_path

        line = None if origin is None else f"in a local frame, whose origin is in {origin_path(path)}"
        self.add(line, origin=origin)

    def end(self) -> None:
        """Print the object, if it is for programs, once. A number that is not finite is null."""
        if self.json and not self._ended:
            import json

            self._ended = True
            typer.echo(json.dumps(_plain(self._values), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """The same in types that JSON has."""
    if hasattr(value, "tolist"):  # an array or a number of NumPy
        value = value.tolist()
    if isinstance(value, dict):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def counted(count: int, what: str) -> str:
    """Such as "1 scan" or "2 scans"."""
    return f"{count} {what}{'s' * (count != 1)}"


def load_map(path: Path) -> Map:
    """Load a map, and warn of tiles that are missing."""
    from radarsdf.tiles.tiled_map import lacking, load

    radar_map = load(path)
    if tiles := lacking(radar_map):
        warn(f"warning: {path} lacks {tiles}: radarsdf tiles status {path} lists the reasons")
    return radar_map


def save_map(radar_map: RadarMap, path: Path) -> None:
    """Save a map, or if that fails, in the temporary folder: a fit is too much work to be lost for its file's name.

    An OSError says where it is instead.
    """
    try:
        radar_map.save(path)
    except (OSError, ValueError) as error:  # ValueError: it is no regular file any more
        import tempfile

        why = getattr(error, "strerror", None) or str(error)
        spare = Path(tempfile.mkdtemp(prefix="radarsdf_")) / path.name
        radar_map.save(spare)
        msg = f"{path} cannot be written ({why}): the map was saved in {spare} instead"
        raise OSError(msg) from error


def until_stopped(page: Page) -> None:
    """Serve a page until Ctrl-C, which is the way to end it and no failure."""
    try:
        page.wait()
    except KeyboardInterrupt:
        typer.echo("stopped")


def split(scans: Scans, every: int | None) -> tuple[Scans, Scans | None]:
    """The scans of a fit, and those that ``--holdout`` leaves out."""
    from radarsdf.evaluation import holdout

    if every is None:
        return scans, None
    train, test = holdout(len(scans.points), every)
    return scans.select(train), scans.select(test)


def add_intensity_errors(results: Results, radar_map: Map, test: Scans, train: Scans) -> None:
    """Add the intensity errors on scans that a fit left out, and those of a kNN baseline on the scans that it used."""
    from radarsdf.evaluation import KNNIntensity, format_metrics, intensity_metrics
    from radarsdf.returns.moving import rays_as_measured
    from radarsdf.tiles.tiled_map import predicted

    if not radar_map.has_intensity or test.intensities is None:
        return
    tested, known = (rays_as_measured(scans, radar_map.config) for scans in (test, train))
    given = len(tested)
    tested, known = (rays.select(rays.with_intensity) for rays in (tested, known))
    if outliers := given - len(tested):
        line = f"{outliers} of {given} held-out intensities are outliers, and are not compared"
        results.add(line, wild_intensities=outliers)
    inside, found = predicted(radar_map, tested)
    if outside := len(tested) - len(inside):
        results.add(f"{outside} of {len(tested)} held-out returns are in no tile", in_no_tile=outside)
    (x, sensors), measured = inside.in_world(), inside.intensities
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
