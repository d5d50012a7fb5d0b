"""Surface of a page, thinned to what a browser can draw, hits of clicks on it, and the quantities that colour it."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bools, Bytes, Floats, Floats32, Ints, Ints32
from radarsdf.checks import check
from radarsdf.core import SurfaceTracer
from radarsdf.io.meshes import MATT, SRGB_TO_LINEAR, encode_glb
from radarsdf.map.colors import SHARES, Scale
from radarsdf.map.map import Map
from radarsdf.map.mesh import renumbered, with_all
from radarsdf.map.threshold import Limits, Threshold

Position = tuple[float, float, float]
UNCERTAINTY = "uncertainty (standard error), m"

_SAMPLES = 30_000  # vertices from which the intensity limits are estimated
# Colours as they are, like those of point clouds and legends.
_UNLIT = MATT | {"extensions": {"KHR_materials_unlit": {}}}
_TO_LIGHT = np.array([-0.35, -0.5, 0.79])
_SHADE = 0.87  # lightness of faces averted from the light; higher keeps colours close to those of the legend
# viser's page passes all meshes, even unlit ones, through three.js's ACESFilmicToneMapping, which turns indigo into navy
# and yellow into olive. It is, on linear colours c:
#     _OUT @ ((x² + a x - b) / (c x² + d x + e)), with x = _IN @ c / _EXPOSURE
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 0.6
_FIT = (0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081)
_BITS = np.uint32(13)  # dropped mantissa bits, below the 256 levels of a screen: zeros compress better


@dataclass(frozen=True)
class ShownSurface:
    vertices: Floats  # (V, 3) world, m
    faces: Ints32  # (F, 3) rows of vertices; normals point into free space
    uncertainty_m: Floats32  # (V,)
    confidence: Floats32  # (V,)
    lightness: Floats32  # (V,) factor of colours
    threshold: Threshold  # confidence threshold of the mesh
    spacing_m: float  # spacing of vertices: the voxel edge, or more if the mesh was thinned

    @classmethod
    def of(cls, radar_map: Map, voxel_size: float, *, max_vertices: int, **wanted: Any) -> "ShownSurface":
        """Mesh a map, and thin the mesh to `max_vertices`. `wanted`: of `Map.mesh`. Raises a ValueError without a surface."""
        mesh: Any = radar_map.mesh(voxel_size, **wanted)
        threshold = Threshold.of_mesh(mesh.metadata)
        mesh, spacing_m = thinned(mesh, max_vertices, voxel_size)
        check(len(mesh.vertices), "the map has no surface here")
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
        names = ("uncertainty_m", "confidence")
        uncertainty_m, confidence = (np.asarray(mesh.vertex_attributes[name], np.float32) for name in names)
        lightness = lightness_of(mesh.vertex_normals)
        return cls(vertices, faces, uncertainty_m, confidence, lightness, threshold, spacing_m)

    def kept(self, max_uncertainty_m: float, min_confidence: float) -> Bools:
        return Limits(None, max_uncertainty_m, 0).met(min_confidence, self.confidence, self.uncertainty_m)

    def part(self, kept: Bools) -> tuple[Ints, Ints32]:
        """Rows (N,) of the vertices of triangles with all vertices kept, and these triangles (M, 3) as indices of these rows."""
        used, faces = renumbered(len(kept), self.faces[with_all(kept, self.faces)])
        return np.flatnonzero(used), faces


def spread_evenly(points: Floats, count: int, edge_m: float) -> tuple[Ints, Ints, float]:
    """Choose at most `count` of points (N, 3), the nearest to each cube's mean: rows, the one of each point, and spacing, m."""
    if len(points) <= count:
        everything = np.arange(len(points))
        return everything, everything, edge_m
    edge_m *= math.sqrt(len(points) / count)
    while True:
        cells = np.floor((points - points.min(axis=0)) / edge_m).astype(np.int64)
        keys = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
        _, of_point, counts = np.unique(keys, return_inverse=True, return_counts=True)
        if len(counts) <= count:
            break
        edge_m *= 1.1
    means = np.stack([np.bincount(of_point, points[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    order = np.lexsort((np.linalg.norm(points - means[of_point], axis=1), of_point))
    return order[np.cumsum(counts) - counts], of_point, edge_m


def thinned(mesh: Any, max_vertices: int, edge_m: float) -> tuple[Any, float]:
    """Thin a mesh to `max_vertices`, one with its attributes per cube of a grid; return it and its vertex spacing, m."""
    import trimesh  # noqa: PLC0415 - slow

    vertices = mesh.vertices
    rows, of_point, spacing_m = spread_evenly(np.asarray(vertices, np.float64), max_vertices, edge_m)
    if len(rows) == len(vertices):
        return mesh, edge_m
    corners = of_point[mesh.faces].astype(np.int32)
    a, b, c = corners.T
    used, faces = renumbered(len(rows), corners[(a != b) & (b != c) & (c != a)])
    rows = rows[used]
    kept = {name: np.asarray(values)[rows] for name, values in mesh.vertex_attributes.items()}
    carried = {"vertex_attributes": kept, "metadata": mesh.metadata}
    thin = trimesh.Trimesh(vertices[rows], faces, process=False, **carried)
    thin.update_faces(thin.unique_faces())
    return thin, spacing_m


def first_hit(vertices: Floats, faces: Ints32, start: ArrayLike, toward: ArrayLike) -> Floats | None:
    """Point (3,) where a ray first hits a mesh, or None. The direction is of any length."""
    origin, direction = np.asarray(start, np.float64), np.asarray(toward, np.float64)
    direction = direction / np.linalg.norm(direction)
    tracer = SurfaceTracer(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int32))
    (range_m,), _ = tracer.first_hits(origin.tolist(), direction[None].astype(np.float32), np.inf)
    return origin + float(range_m) * direction if np.isfinite(range_m) else None


def glb(vertices: Array, faces: Array, colors: Bytes) -> bytes:
    """Encode vertices (V, 3), as float32, faces (F, 3) and sRGB colours (V, 3) as the bytes of a GLB file."""
    return encode_glb(vertices, faces, {"COLOR_0": light_to_show(colors)}, material=_UNLIT)


def lightness_of(normals: Array) -> Floats32:
    """(V,) lightness factor, at most 1, for normals (V, 3), which makes the shape visible."""
    light = np.clip(np.asarray(normals, np.float64) @ _TO_LIGHT, 0.0, 1.0)
    return np.asarray(_SHADE + (1 - _SHADE) * light, np.float32)


def shaded(colors: Bytes, lightness: Array) -> Bytes:
    """Scale the OKLab lightness and chroma of sRGB colours (V, 3) by factors (V,): both are cube roots of light."""
    light = SRGB_TO_LINEAR[colors] * np.asarray(lightness, np.float64)[:, None] ** 3
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * srgb), np.uint8)


def light_to_show(colors: Bytes) -> Floats32:
    """(V, 3) linear colours of an unlit mesh that the page shows as these sRGB colours (V, 3): the inverse tone mapping."""
    a, b, c, d, e = _FIT
    y = SRGB_TO_LINEAR[colors] @ np.linalg.inv(_OUT).T
    square, slope, rest = 1 - c * y, a - d * y, -b - e * y
    x = (-slope + np.sqrt(np.maximum(slope**2 - 4 * square * rest, 0))) / (2 * square)
    light = np.ascontiguousarray(_EXPOSURE * x @ np.linalg.inv(_IN).T, np.float32)
    bits = light.view(np.uint32)
    half = np.uint32(1) << (_BITS - np.uint32(1))
    return ((bits + half) >> _BITS << _BITS).view(np.float32)


@dataclass(frozen=True)
class Quantity:
    label: str  # name and unit
    values: Callable[[Ints, Position], Array]  # (N,) of vertices (N,), for a sensor at a position
    scale: Scale
    of_sensor: bool = False  # whether it depends on the sensor position


def quantities_of(radar_map: Map, surface: ShownSurface, sensor: Position) -> dict[str, Quantity]:
    """Quantities by name, the default first. The intensity scale is that for the first `sensor` position."""
    vertices, found = surface.vertices, {}

    def intensity(rows: Ints, sensor: Position) -> Array:
        return radar_map.intensity(vertices[rows], np.array(sensor))

    if radar_map.has_intensity:
        some = np.arange(0, len(vertices), max(1, len(vertices) // _SAMPLES))
        scale = Scale.of(intensity(some, sensor))
        found["intensity"] = Quantity("predicted intensity, sensor units", intensity, scale, of_sensor=True)
    of_vertices: dict[str, tuple[str, Array]] = {
        "uncertainty": (UNCERTAINTY, surface.uncertainty_m),
        "confidence": ("confidence (probability)", surface.confidence),
        "height": ("height, m", vertices[:, 2]),
    }
    for name, (label, values) in of_vertices.items():
        scale = SHARES if name == "confidence" else Scale.of(values)
        found[name] = Quantity(label, lambda rows, _, values=values: values[rows], scale)  # type: ignore[misc]
    return found


def as_html(name: str, value: Any) -> str:
    """Fill a macro of ``templates/panel.html``, such as "legend"."""
    return str(getattr(templates_of("view").get_template("panel.html").module, name)(value))


@functools.cache
def templates_of(subpackage: str) -> jinja2.Environment:
    """Environment of the templates of a subpackage, which escapes all values."""
    options: dict[str, Any] = dict.fromkeys(("autoescape", "trim_blocks", "lstrip_blocks"), True)
    options |= {"undefined": jinja2.StrictUndefined, "extensions": ["jinja2.ext.do"]}
    environment = jinja2.Environment(loader=jinja2.PackageLoader(f"radarsdf.{subpackage}"), **options)
    environment.filters["css_color"] = css_color
    environment.globals["gradient"] = ",".join(map(css_color, SHARES(np.linspace(0, 1, 9)).tolist()))
    return environment


def css_color(color: Sequence[int]) -> str:
    return "rgb({} {} {})".format(*color)
