# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pictures of a mesh, drawn in NumPy: they need no display and no OpenGL."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import real_array
from radarsdf.io.files import write_whole
from radarsdf.map.colors import NEUTRAL, intensity_colors
from radarsdf.render.figures import new_figure, png_of
from radarsdf.render.raster import PIXELS_AT_ONCE, barycentric, contours, corner_normals, project, rasterise

if TYPE_CHECKING:
    import trimesh

_Floats = NDArray[np.float64]

_SUPERSAMPLING = 2  # subpixels per pixel and axis, which are averaged for smooth edges


def render(
    mesh: trimesh.Trimesh,
    colors: ArrayLike | None = None,
    *,
    width: int = 1600,
    height: int = 1000,
    viewpoint: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Render a mesh on white, lit from behind the viewer, upper left.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The surface, m, with z up. Both sides of a triangle are drawn.
    colors : (V, 3) or (V, 4) array_like of uint8, optional
        Vertex colours. Alpha is ignored. None: light grey.
    width, height : int
        Size of the picture in pixels.
    viewpoint : (3,) array_like, optional
        Position of the viewer, world frame, m. The view is aimed at the mesh and zoomed to fill the picture. None:
        obliquely from above one of its longer sides. Triangles that reach behind the viewer are not drawn.

    Returns
    -------
    (height, width, 3) uint8
        Red, green and blue.

    Raises
    ------
    ValueError
        If the mesh has no triangles, or the shape of the colours or of the viewpoint is wrong.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        msg = "the mesh has no triangles to draw"
        raise ValueError(msg)
    rgb = np.array(NEUTRAL)[None].repeat(len(vertices), axis=0) if colors is None else np.asarray(colors)
    if rgb.shape not in {(len(vertices), 3), (len(vertices), 4)}:
        msg = f"colors must be ({len(vertices)}, 3) or (…, 4), not {rgb.shape}"
        raise ValueError(msg)
    origin = vertices.mean(axis=0)
    vertices = vertices - origin
    eye, axes = _camera(vertices[np.unique(faces)], viewpoint, origin)
    fine = (height * _SUPERSAMPLING, width * _SUPERSAMPLING)
    x, y, nearness = project((vertices - eye) @ axes.T, faces, fine)
    faces = faces[np.isfinite(nearness[faces]).all(axis=1)]  # entirely in front of the viewer
    ids, near = rasterise(x[faces], y[faces], nearness[faces], fine)

    image = np.full((*fine, 3), 255.0, dtype=np.float32)
    normals = corner_normals(vertices, faces)
    light = np.array([-0.45, 0.55, -0.70]) @ axes  # from the upper left, behind the viewer
    for start in range(0, ids.size, PIXELS_AT_ONCE):
        part = np.arange(start, min(start + PIXELS_AT_ONCE, ids.size))
        part = part[ids.flat[part] >= 0]
        f = ids.flat[part]
        weight = barycentric(x[faces[f]], y[faces[f]], part % fine[1], part // fine[1])
        weight *= nearness[faces[f]]  # perspective correction: now linear in space, not in the picture
        weight /= weight.sum(axis=1, keepdims=True)
        normal = np.einsum("ni,nij->nj", weight, normals[f])
        to_eye = eye - np.einsum("ni,nij->nj", weight, vertices[faces[f]])
        normal *= np.sign(np.einsum("nj,nj->n", normal, to_eye))[:, None]
        lambert = np.maximum(normal @ light / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0.0)
        color = np.einsum("ni,nij->nj", weight, rgb[faces[f], :3])
        image.reshape(-1, 3)[part] = color * (0.42 + 0.60 * lambert)[:, None]
    image *= contours(near, 2 * _SUPERSAMPLING)[..., None]
    image = image.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3).mean(axis=(1, 3))
    picture: NDArray[np.uint8] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return picture


def save_picture(
    path: str | PathLike[str],
    mesh: trimesh.Trimesh,
    *,
    scalar: ArrayLike | None = None,
    label: str = "intensity",
    low: float | None = None,
    high: float | None = None,
    width: int = 1600,
    height: int = 1000,
    viewpoint: ArrayLike | None = None,
) -> None:
    """Save a PNG picture of a mesh, with a colour bar if a scalar colours it.

    Parameters
    ----------
    path : path-like
        The PNG file. An existing file is replaced once the new one is complete.
    mesh : trimesh.Trimesh
        The surface, m, with z up.
    scalar : (V,) array_like, optional
        A value per vertex, such as its intensity. NaN is grey. None: all of the surface is light grey.
    label : str
        Text of the colour bar, with the unit.
    low, high : float, optional
        Limits of the colour scale. None: the 2nd and the 98th percentile.
    width, height : int
        Size of the picture in pixels.
    viewpoint : (3,) array_like, optional
        As in `render`.

    Raises
    ------
    ImportError
        If matplotlib is not installed. It comes with the extra `plot`.
    ValueError
        As `render` and `intensity_colors`, or if the shape of `scalar` is wrong.
    OSError
        If the file cannot be written.
    """
    dpi = 100
    figure = new_figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    if scalar is None:
        image = render(mesh, width=width, height=height, viewpoint=viewpoint)
    else:
        from matplotlib.cm import ScalarMappable  # noqa: PLC0415
        from matplotlib.colors import ListedColormap, Normalize  # noqa: PLC0415

        values = real_array(scalar, "scalar")
        if values.shape != (len(mesh.vertices),):
            msg = f"scalar must be ({len(mesh.vertices)},), one value per vertex, not {values.shape}"
            raise ValueError(msg)
        known = values[np.isfinite(values)]
        limits = np.percentile(known, [2, 98]) if known.size else np.array([0.0, 1.0])
        lower, upper = float(limits[0] if low is None else low), float(limits[1] if high is None else high)
        colors = intensity_colors(values, lower, upper)
        image = render(mesh, colors, width=round(0.9 * width), height=height, viewpoint=viewpoint)
        axes = figure.add_axes((0.92, 0.3, 0.012, 0.4))
        steps = intensity_colors(np.linspace(0, 1, 256), 0, 1) / 255.0
        beyond = int((known < lower).any()) + 2 * int((known > upper).any())
        extend: Any = ("neither", "min", "max", "both")[beyond]
        bar = figure.colorbar(
            ScalarMappable(Normalize(lower, upper), ListedColormap(steps)), cax=axes, extend=extend
        )
        bar.set_label(label, size=13)
        bar.ax.tick_params(labelsize=12)
        bar.outline.set_visible(False)
    figure.figimage(image, 0, 0)
    write_whole(path, png_of(figure, dpi=dpi))


def eye_around(points: _Floats, turn_deg: float = 25.0, rise_deg: float = 36.0) -> _Floats:
    """Position (3,) from which all points (N, 3), m, with z up, are visible, `rise_deg` above the horizon.

    It faces the southern one of their two longer sides, turned by `turn_deg`, anticlockwise as seen from above.
    """
    center, radius = middle_of(points)
    spread = points[:, :2] - points[:, :2].mean(axis=0)
    along = np.linalg.eigh(spread.T @ spread)[1][:, 1]
    across = np.array([along[1], -along[0]])
    across *= -1.0 if across[1] > 0 else 1.0  # of the two sides, the southern one
    turn, rise = np.deg2rad([turn_deg, rise_deg])
    flat = np.cos(turn) * across + np.sin(turn) * np.array([-across[1], across[0]])
    return np.asarray(center + 2.6 * radius * np.array([*(np.cos(rise) * flat), np.sin(rise)]))


def middle_of(points: _Floats) -> tuple[_Floats, float]:
    """Centre (3,) of the bounding box of points (N, 3), and half its diagonal, without a few stray points."""
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return 0.5 * (low + high), max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def _camera(points: _Floats, viewpoint: ArrayLike | None, origin: _Floats) -> tuple[_Floats, _Floats]:
    """Position (3,) of the eye relative to `origin`, and its axes (3, 3): right, up, forward."""
    center, radius = middle_of(points)
    if viewpoint is None:
        eye = eye_around(points)
    else:
        eye = real_array(viewpoint, "viewpoint")
        if eye.shape != (3,) or not np.isfinite(eye).all():
            msg = "viewpoint must be (3,) and finite"
            raise ValueError(msg)
        eye = eye - origin
    forward = center - eye
    if np.linalg.norm(forward) < 1e-9 * radius:
        forward = np.array([0.0, 1.0, 0.0])
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # looking straight down or up: north is at the top
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return eye, np.stack([right, np.cross(right, forward), forward])
