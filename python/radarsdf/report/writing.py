"""Reports on maps and on changes. The templates in `templates/` hold all prose; Jinja escapes every value."""

import base64
import io
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.arrays import Array, ArrayLike, Bytes, Floats
from radarsdf.changes.changes import CHANGED, NAMES, Changes, Region, colors_of
from radarsdf.checking.recording import Finding
from radarsdf.checks import AnyPath
from radarsdf.config.fit_config import FitConfig, flat_settings, to_toml
from radarsdf.evaluation import intensity_metrics, surface_metrics, uncertainty_metrics
from radarsdf.extras import require
from radarsdf.io.files import write_whole
from radarsdf.map.colors import NEUTRAL, SHARES, Scale
from radarsdf.map.map import Map
from radarsdf.map.threshold import Threshold
from radarsdf.render.figures import draw_trajectories, new_figure, png_of
from radarsdf.render.picture import eye_around, middle_of, render
from radarsdf.returns.moving import rays_as_measured
from radarsdf.scans import Scans
from radarsdf.threads import resolve_num_threads
from radarsdf.tiles.tiled_map import predicted
from radarsdf.view.pages import MEANING, centre_of
from radarsdf.view.serving import LOCALHOST, aim, framing_pose, free_port, start_server, stop_server
from radarsdf.view.surface import glb, templates_of, thinned

MAX_VERTICES = 160_000  # limit of the mesh in the 3D scene and the pictures, which is thinned above it
_WIDTH, _HEIGHT = 1040, 650  # pixels
_SCENE_ASPECT = 8 / 5  # aspect ratio of its frame on any screen, see the style in page.html
_STEPS_PER_M = 1024  # vertices are rounded to multiples of 1 m / 1024: fewer digits save a sixth of the file
_SENSOR_COLOR = (0, 114, 178)
# The icon holds the only address of another machine in viser's page, though only as the name of an XML namespace.
_ICON = re.compile(r'<link\s+rel="icon".*?/>', re.DOTALL)
# Azimuth and elevation of each view, degrees, if they are not the usual ones. Straight down, walls would be lines.
_SIDES: dict[str, tuple[float, ...]] = {"One long side": (), "Steeply from above": (0.0, 70.0)}
_FIRST, _SECOND = "#0072b2", "#d55e00"  # distinguishable by colour-blind readers
_SAMPLES = 1_000_000
_MATCH_M = 0.4  # a vertex farther from the truth is an outlier rather than an inaccurate surface
_MIN_MATCHES = 100
_MAX_RETURNS = 100_000  # evenly spread; more would not change a plot


@dataclass(frozen=True)
class Subject:
    """A map and the data it is compared with."""

    radar_map: Map
    name: str  # title of the page
    scans: Scans | None = None  # those fitted, or those to compare with
    held_out: Scans | None = None  # those that the fit left out, if known
    findings: Sequence[Finding] | None = None  # result of `radarsdf.check` on all scans; None: not checked
    voxel_size_m: float = 0.1  # voxels of the evaluated mesh
    box: ArrayLike | None = None  # (2, 3) corners of the reported part of the world, m; None: all
    progress: bool | None = None
    explained: Floats | None = None  # (F,) shares of the returns of `scans` that the map explains
    limits: Mapping[str, Any] = field(default_factory=dict)  # limits of the mesh: arguments of `Map.mesh`

    @property
    def viewpoint(self) -> Floats:
        """(3,) sensor position for predicted intensities: that of the middle scan, or the map's origin; world, m."""
        if self.scans is None:
            return self.radar_map.origin
        return np.asarray(self.scans.sensor_poses[len(self.scans) // 2, :3, 3], np.float64)

    @cached_property
    def mesh(self) -> Any:
        """The evaluated mesh, with intensities if the map has any."""
        viewpoint = self.viewpoint if self.radar_map.has_intensity else None
        limits: dict[str, Any] = {**self.limits, "box": self.box, "viewpoint": viewpoint}
        return self.radar_map.mesh(self.voxel_size_m, progress=self.progress, **limits)

    @cached_property
    def shown(self) -> tuple[Any, float]:
        """The drawn mesh, and its vertex spacing, m."""
        return thinned(self.mesh, MAX_VERTICES, self.voxel_size_m)

    @cached_property
    def ground_truth(self) -> Floats | None:
        """(M, 3) ground-truth points in the box, world, m; None if there are none."""
        if self.scans is None or self.scans.ground_truth is None:
            return None
        truth = np.asarray(self.scans.ground_truth, np.float64)
        if self.box is not None:
            low, high = np.asarray(self.box, np.float64)
            truth = truth[((truth >= low) & (truth <= high)).all(axis=1)]
        return truth if len(truth) else None

    @cached_property
    def truth_tree(self) -> Any:
        return cKDTree(self.ground_truth)

    def picture(self, values: Array, label: str, scale: Scale) -> dict[str, Any]:
        """Render the drawn mesh coloured by values (V,) of its vertices, and describe the colours."""
        colors, legend = _colored(self.shown[0], values, label, scale)
        return {"picture": _picture(self.shown[0], colors), "legend": legend}


def require_extras() -> None:
    """Raise an ImportError with the install command if matplotlib or viser is missing."""
    require("matplotlib", "viser", what="a report needs")


def write_report(path: AnyPath, subject: Subject) -> int:
    """Write a self-contained HTML page about a map atomically, and return its size, bytes. Needs matplotlib and viser."""
    report = subject.radar_map.report
    settings, defaults = (flat_settings(of.to_dict()) for of in (subject.radar_map.config, FitConfig()))
    of_surface = {"surface": surface_values, "errors": error_values, "uncertainty": uncertainty_values}
    has_surface = len(subject.mesh.faces) != 0
    return _write_page(
        path,
        "report.html",
        subject=subject,
        report=report,
        fit_s=sum(value for name, value in report.items() if name.endswith("_s") and name != "skipped_s"),
        poses=pose_values(report.get("poses")),
        **{name: values(subject) if has_surface else None for name, values in of_surface.items()},
        intensity=intensity_values(subject),
        changed=[(n, value, defaults[n]) for n, value in settings.items() if value != defaults[n]],
        toml=to_toml(subject.radar_map.config),
    )


def write_changes_report(
    path: AnyPath, changes: Changes, names: tuple[str, str], edge_m: float, regions: Sequence[Region]
) -> int:
    """Write a self-contained HTML page about changes atomically, and return its size, bytes.

    `names`: of the earlier and the later map. `edge_m`: vertex spacing of their surfaces. `regions`: the changes to
    list, largest first. Raises an ImportError if matplotlib or viser is missing, an OSError if the file cannot be written.
    """
    mesh: Any = thinned(changes.mesh(), MAX_VERTICES, edge_m)[0]
    surface = None
    if len(mesh.faces):
        colors = colors_of(mesh.vertex_attributes["kind"])
        surface = _pictures(mesh, colors, np.asarray(mesh.vertices, np.float64).mean(axis=0))
    values = {"report": changes.report, "regions": regions, "kinds": [NAMES[kind] for kind in CHANGED]}
    return _write_page(path, "changes.html", names=names, surface=surface, key=MEANING, **values)


def surface_values(subject: Subject) -> dict[str, Any]:
    mesh, _ = subject.shown
    colors, legend = _colored(mesh, mesh.vertex_attributes.get("intensity"), "intensity, sensor units")
    origin = subject.radar_map.origin
    sensors = None if subject.scans is None else subject.scans.sensor_poses[:, :3, 3] - origin
    values = {"legend": legend, "threshold": Threshold.of_mesh(subject.mesh.metadata)}
    return values | _pictures(mesh, colors, origin, sensors, subject.explained)


def error_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the section of surface errors, or None without a truth."""
    truth, mesh = subject.ground_truth, subject.mesh
    if truth is None:
        return None
    metrics = surface_metrics(mesh, truth, box=subject.box, samples=_SAMPLES)
    shown_m, _ = subject.truth_tree.query(subject.shown[0].vertices, workers=resolve_num_threads(0))
    pictured = subject.picture(shown_m, "distance to the truth, m", Scale(0.0, _MATCH_M))
    return {"metrics": metrics, **pictured}


def uncertainty_values(subject: Subject) -> dict[str, Any]:
    mesh, (shown, _) = subject.mesh, subject.shown
    sigma_m = np.asarray(mesh.vertex_attributes["uncertainty_m"], np.float64)
    shown_m, percentiles = shown.vertex_attributes["uncertainty_m"], [10, 50, 90]
    return {
        **subject.picture(shown_m, "standard error, m", Scale.of(sigma_m)),
        "percentiles": percentiles,
        "sigma_m": np.nanpercentile(sigma_m, percentiles).tolist(),
        "confidence": np.nanpercentile(mesh.vertex_attributes["confidence"], percentiles).tolist(),
        "against_truth": _calibration(subject, sigma_m),
    }


def _calibration(subject: Subject, sigma_m: Floats) -> dict[str, Any] | None:
    """Errors compared with predicted uncertainties, or None if too little of the surface is near the truth."""
    mesh, truth = subject.mesh, subject.ground_truth
    if truth is None:
        return None
    vertices = np.asarray(mesh.vertices, np.float64)
    distance_m, nearest = subject.truth_tree.query(vertices, workers=resolve_num_threads(0))
    error_m = ((truth[nearest] - vertices) * np.asarray(mesh.vertex_normals)).sum(axis=1)
    error_m[distance_m > _MATCH_M] = np.nan
    if np.count_nonzero(np.isfinite(error_m) & np.isfinite(sigma_m)) < _MIN_MATCHES:
        return None
    metrics = uncertainty_metrics(error_m, sigma_m)
    predicted_m, measured_m = metrics["decile_predicted_m"], metrics["decile_rmse_m"]
    figure, ax = _subplots()
    most = 1.1 * max(*predicted_m, *measured_m)
    ax.plot([0, most], [0, most], color="gray", linestyle="--", linewidth=1, label="ideal")
    ax.plot(predicted_m, measured_m, "o-", color=_FIRST, markersize=4, label="this map")
    ax.set(xlabel="predicted uncertainty, m", ylabel="RMS error, m", xlim=(0, most), ylim=(0, most))
    ax.legend(frameon=False, loc="upper left")
    matched = {"matched": metrics["num_points"] / len(vertices), "match_m": _MATCH_M}
    return metrics | matched | {"plot": _png(figure)}


def intensity_values(subject: Subject) -> dict[str, Any] | None:
    """Values of the intensity section, on held-out scans if there are any. None if there is nothing to compare."""
    scans = subject.scans if subject.held_out is None else subject.held_out
    if not subject.radar_map.has_intensity or scans is None or scans.intensities is None:
        return None
    every_ray = rays_as_measured(scans, subject.radar_map.config)
    usable = every_ray.select(every_ray.with_intensity)
    rows = np.linspace(0, len(usable) - 1, min(len(usable), _MAX_RETURNS)).astype(np.int64)
    rays, found = predicted(subject.radar_map, usable.select(rows))
    measured = np.asarray(rays.intensities, np.float64)
    metrics = intensity_metrics(found, measured)
    deviation = np.abs(measured - np.median(measured))
    return {
        "scans": len(scans),
        "returns": len(rays),
        "left_out": {"outliers": len(every_ray) - len(usable), "in no tile": len(rows) - len(rays)},
        "errors": [metrics["mae"], metrics["medae"]],
        "errors_of_median": [float(deviation.mean()), float(np.median(deviation))],
        "density": _density(measured, found),
    }


def _density(measured: Floats, found: Floats) -> bytes:
    from matplotlib.colors import LogNorm  # noqa: PLC0415 - an extra

    figure, ax = _subplots()
    low, high = np.percentile(np.concatenate([measured, found]), [0.2, 99.8])
    high = max(high, low + 1e-6)
    bins = np.linspace(low, high, 61)
    *_, drawn = ax.hist2d(measured, found, bins, cmap="viridis", norm=LogNorm(), cmin=1)
    ax.plot([low, high], [low, high], color=_SECOND, linewidth=1.5, label="equal")
    ax.set(xlabel="measured intensity", ylabel="predicted intensity", xlim=(low, high), ylim=(low, high))
    ax.legend(frameon=False, loc="upper left")
    figure.colorbar(drawn, label="returns", pad=0.02)
    return _png(figure)


def pose_values(poses: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Values of the section on estimated poses. `poses`: their part of a map's report, None for poses used as passed."""
    if poses is None:
        return None
    after = np.array(poses["after"])
    before = None if poses["before"] is None else np.array(poses["before"])
    sigma_m, sigma_deg = np.median(poses["sigma_m"]), np.degrees(np.median(poses["sigma_rad"]))
    figure, ax = _subplots()
    draw_trajectories(ax, {"after": after} if before is None else {"before": before, "after": after})
    return {
        "verdict": poses["verdict"],
        "improved": poses["improved"],
        "trajectory": _png(figure),
        "sigma": (sigma_m, sigma_deg) if sigma_m else None,
        "length_m": np.linalg.norm(np.diff(after, axis=0), axis=1).sum(),
        "moved_m": None if before is None else np.linalg.norm(after - before, axis=1),
    }


def _subplots() -> tuple[Any, Any]:
    """Create a figure with axes, small enough for text to stay legible on a phone."""
    figure = new_figure(figsize=(4.4, 3.3), dpi=180, layout="constrained", facecolor="white")
    return figure, figure.subplots()


def _png(figure: Any) -> bytes:
    for ax in figure.axes:
        if ax.get_label() != "<colorbar>":
            ax.grid(alpha=0.3)
            ax.spines[["top", "right"]].set_visible(False)
    return png_of(figure, metadata={"Software": None})


def _colored(
    mesh: Any, values: Array | None, label: str, scale: Scale | None = None
) -> tuple[Bytes, dict[str, Any] | None]:
    """Map values (V,) of the vertices to colours (V, 3), with a legend. NaN is grey, as is everything without values."""
    if values is None or not np.isfinite(values).any():
        return np.full((len(mesh.vertices), 3), NEUTRAL, np.uint8), None
    scale = scale or Scale.of(values)
    return scale(values), {"label": label, "scale": scale}


def _pictures(
    mesh: Any, colors: Bytes, origin: Floats, sensors: Floats | None = None, explained: Floats | None = None
) -> dict[str, Any]:
    """Show a mesh with vertex colours (V, 3) in a :func:`scene` around `origin`, and from each of its sides, by name."""
    local = np.asarray(mesh.vertices, np.float64) - origin
    views = {name: _picture(mesh, colors, *side) for name, side in _SIDES.items()}
    return {"scene": scene(local, mesh.faces, colors, sensors, explained), "views": views}


def _picture(mesh: Any, colors: Bytes, *side: float) -> bytes:
    """Render a mesh with vertex colours (V, 3), seen from :func:`eye_around`, as JPEG."""
    from PIL import Image  # noqa: PLC0415 - comes with matplotlib, an extra

    eye = eye_around(np.asarray(mesh.vertices, np.float64), *side)
    pixels = render(mesh, colors, width=_WIDTH, height=_HEIGHT, viewpoint=eye)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="jpeg", quality=82, optimize=True)
    return file.getvalue()


def scene(
    vertices: Floats, faces: Array, colors: Bytes, sensors: Floats | None, explained: Floats | None
) -> str:
    """Export a self-contained HTML page that shows a mesh in 3D, made by viser.

    `vertices` (V, 3) and `sensors` (F, 3), drawn as points, are in m near the origin, since the page computes in
    float32. Shares `explained` (F,) colour the sensors. viser exports the scene of a server, which listens on this machine for less than a second. The addresses of
    other machines in its program are never used; the report's content security policy forbids fetching them.
    """
    everything = vertices if sensors is None else np.concatenate([vertices, sensors])
    to_eye = eye_around(vertices) - middle_of(vertices)[0]
    pose = framing_pose(everything, to_eye, _SCENE_ASPECT)
    server: Any = start_server(LOCALHOST, free_port(LOCALHOST, 0))
    try:
        data = glb(np.round(vertices * _STEPS_PER_M) / _STEPS_PER_M, faces, colors)
        server.scene.add_glb("/surface", data, cast_shadow=False, receive_shadow=False)
        if sensors is not None:
            size = 0.008 * float(np.linalg.norm(pose.position - pose.look_at))
            style = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            sensor_colors = _SENSOR_COLOR if explained is None else SHARES(explained)
            server.scene.add_point_cloud("/sensor", sensors.astype(np.float32), sensor_colors, **style)
        aim(server.initial_camera, pose)
        document: str = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    return _ICON.sub("", document)


def _write_page(path: AnyPath, template: str, **values: Any) -> int:
    made = time.strftime("%Y-%m-%d %H:%M")
    environment, filters = templates_of("report"), (centre_of, data_uri, fixed, math.degrees, percent)
    environment.filters |= {own.__name__: own for own in filters}
    data = environment.get_template(template).render(made=made, **values).encode()
    write_whole(path, data)
    return len(data)


def fixed(value: float, digits: int, unit: str = "") -> str:
    """Format a number with a fixed number of decimals and its unit."""
    return f"{value:,.{digits}f}" + (unit if unit in ("", "°") else "\N{NO-BREAK SPACE}" + unit)


def percent(share: float) -> str:
    return fixed(100 * share, 1, "%")


def data_uri(image: bytes) -> str:
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"
