"""Ray-cast pictures of a mesh, which need no display and no OpenGL."""

import numpy as np

from radarsdf.arrays import ArrayLike, Bytes, Floats, Floats32, Ints32, Mesh
from radarsdf.checks import AnyPath, check, real_array
from radarsdf.core import SurfaceTracer
from radarsdf.io.files import write_whole
from radarsdf.map.colors import NEUTRAL, SHARES, Scale
from radarsdf.render.figures import new_figure, png_of
from radarsdf.threads import resolve_num_threads

_PIXELS_AT_ONCE = 1 << 20  # limit of memory
_CREASE = np.cos(np.deg2rad(40.0))  # edges with a larger angle are drawn sharp, others are shaded smoothly
_SUPERSAMPLING = 2  # subpixels per pixel and axis, which are averaged for smooth edges


def render(
    mesh: Mesh,
    colors: ArrayLike | None = None,
    *,
    width: int = 1600,
    height: int = 1000,
    viewpoint: ArrayLike | None = None,
) -> Bytes:
    """Render a mesh on white, lit from behind the viewer, upper left.

    Raises a ValueError if the mesh has no triangles, or the shape of the colours or of the viewpoint is wrong.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The surface, m, with z up. Both sides of a triangle are drawn.
    colors : (V, 3) or (V, 4) array_like of uint8, optional
        Vertex colours. Alpha is ignored. None: light grey.
    width, height : int
        Size of the picture in pixels.
    viewpoint : (3,) array_like, optional
        Position of the viewer, world frame, m. The view is centred on the mesh and zoomed to fill the picture. None:
        obliquely from above one of its longer sides. Triangles that reach behind the viewer are not drawn.

    Returns
    -------
    (height, width, 3) uint8
        Red, green and blue.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int32).reshape(-1, 3)
    check(len(faces) != 0, "the mesh has no triangles to draw")
    rgb = np.array(NEUTRAL)[None].repeat(len(vertices), axis=0) if colors is None else np.asarray(colors)
    fits = rgb.shape in {(len(vertices), 3), (len(vertices), 4)}
    check(fits, f"colors must be ({len(vertices)}, 3) or (…, 4), not {rgb.shape}")
    origin = vertices.mean(axis=0)
    vertices = vertices - origin
    eye, axes = _camera(vertices[np.unique(faces)], viewpoint, origin)
    seen = (vertices - eye) @ axes.T
    in_front = seen[:, 2] > 1e-3 * np.abs(seen[:, 2]).max()
    faces = faces[in_front[faces].all(axis=1)]
    rows, columns = height * _SUPERSAMPLING, width * _SUPERSAMPLING
    frame = _zoom(seen[np.unique(faces)], rows, columns)
    if frame is None:
        return np.full((height, width, 3), 255, np.uint8)

    (middle_u, middle_v), focal = frame
    right, up, forward = axes
    light = np.array([-0.45, 0.55, -0.70]) @ axes  # from the upper left, behind the viewer
    normals = _corner_normals(vertices, faces)
    threads = resolve_num_threads(0)
    tracer = SurfaceTracer(vertices, faces, threads)
    u = middle_u + (np.arange(columns) + 0.5 - columns / 2) / focal
    v = middle_v + (np.arange(rows) + 0.5 - rows / 2) / focal
    image = np.full((rows, columns, 3), 255.0, np.float32)
    depth = np.full((rows, columns), np.inf)
    for part in np.array_split(np.arange(rows), -(-rows * columns // _PIXELS_AT_ONCE)):
        rays = u[None, :, None] * right - v[part][:, None, None] * up + forward  # depth 1
        length = np.linalg.norm(rays, axis=2)
        directions = np.asarray(rays / length[..., None], np.float32).reshape(-1, 3)
        range_m, face = tracer.first_hits(eye.tolist(), directions, np.inf, False, threads)
        depth[part] = range_m.reshape(length.shape) / length
        hit = (face >= 0).reshape(length.shape)
        f = face[face >= 0]
        points = eye + depth[part][hit][:, None] * rays[hit]
        weight = _barycentric(points, vertices[faces[f]])
        normal = np.einsum("ni,nij->nj", weight, normals[f])
        normal *= np.sign(np.einsum("nj,nj->n", normal, eye - points))[:, None]
        lambert = np.maximum(normal @ light / np.maximum(np.linalg.norm(normal, axis=1), 1e-12), 0.0)
        color = np.einsum("ni,nij->nj", weight, rgb[faces[f], :3])
        image[part[0] : part[-1] + 1][hit] = color * (0.42 + 0.60 * lambert)[:, None]
    image *= _contours(depth, 2 * _SUPERSAMPLING)[..., None]
    image = image.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def save_picture(
    path: AnyPath,
    mesh: Mesh,
    *,
    scalar: ArrayLike | None = None,
    label: str = "intensity",
    width: int = 1600,
    height: int = 1000,
    viewpoint: ArrayLike | None = None,
) -> None:
    """Save a PNG picture of a mesh, with a colour bar if a scalar colours it.

    Raises the errors of :func:`render`, an ImportError without matplotlib (the extra `plot`), or an OSError.

    Parameters
    ----------
    path : path-like
        The PNG file. An existing file is replaced once the new one is complete.
    mesh, width, height, viewpoint
        As for :func:`render`.
    scalar : (V,) array_like, optional
        A value per vertex, such as its intensity, coloured from the 2nd to the 98th percentile; NaN is light grey. None: all is.
    label : str
        Text of the colour bar, with the unit.
    """
    dpi = 100
    figure = new_figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    if scalar is None:
        image = render(mesh, width=width, height=height, viewpoint=viewpoint)
    else:
        from matplotlib.cm import ScalarMappable  # noqa: PLC0415
        from matplotlib.colors import ListedColormap, Normalize  # noqa: PLC0415

        values = real_array(scalar, "scalar")
        fits = values.shape == (len(mesh.vertices),)
        check(fits, f"scalar must be ({len(mesh.vertices)},), one value per vertex, not {values.shape}")
        scale = Scale.of(values)
        image = render(mesh, scale(values), width=round(0.9 * width), height=height, viewpoint=viewpoint)
        axes = figure.add_axes((0.92, 0.3, 0.012, 0.4))
        steps = SHARES(np.linspace(0, 1, 256)) / 255.0
        shades = ScalarMappable(Normalize(scale.low, scale.high), ListedColormap(steps))
        bar = figure.colorbar(shades, cax=axes, extend="both")
        bar.set_label(label, size=13)
        bar.ax.tick_params(labelsize=12)
        bar.outline.set_visible(False)
    figure.figimage(image, 0, 0)
    write_whole(path, png_of(figure, dpi=dpi))


def eye_around(points: Floats, turn_deg: float = 25.0, rise_deg: float = 36.0) -> Floats:
    """Position (3,) from which all points (N, 3), m, with z up, are visible, `rise_deg` above the horizon.

    It faces the southern one of their two longer sides, rotated by `turn_deg`, anticlockwise as seen from above.
    """
    center, radius = middle_of(points)
    spread = points[:, :2] - points[:, :2].mean(axis=0)
    along = np.linalg.eigh(spread.T @ spread)[1][:, 1]
    across = np.array([along[1], -along[0]])
    across *= -1.0 if across[1] > 0 else 1.0  # face the southern side
    turn, rise = np.deg2rad([turn_deg, rise_deg])
    flat = np.cos(turn) * across + np.sin(turn) * np.array([-across[1], across[0]])
    return np.asarray(center + 2.6 * radius * np.array([*(np.cos(rise) * flat), np.sin(rise)]))


def middle_of(points: Floats) -> tuple[Floats, float]:
    """Centre (3,) of the bounding box of points (N, 3), and half its diagonal, ignoring a few stray points."""
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return 0.5 * (low + high), max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def _camera(points: Floats, viewpoint: ArrayLike | None, origin: Floats) -> tuple[Floats, Floats]:
    """Position (3,) of the eye relative to `origin`, and its axes (3, 3): right, up, forward."""
    center, radius = middle_of(points)
    eye = eye_around(points) + origin if viewpoint is None else real_array(viewpoint, "viewpoint")
    check(eye.shape == (3,) and np.isfinite(eye).all(), "viewpoint must be (3,) and finite")
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


def _zoom(seen: Floats, rows: int, columns: int) -> tuple[Floats, float] | None:
    """Middle (2,) of the picture, and pixels per unit, both at depth 1, for points (N, 3) along the axes of the eye."""
    # None if all of them are more than 56° off its axis. The zoom ignores such points.
    screen = np.stack([seen[:, 0], -seen[:, 1]]) / seen[:, 2]
    screen = screen[:, np.hypot(*screen) <= 1.5]
    if screen.shape[1] == 0:
        return None
    low, high = np.percentile(screen, [2, 98], axis=1)
    reach = 0.2 * (high - low)  # keeps a compact scene whole, but ignores a few stray triangles
    low, high = np.maximum(low - reach, screen.min(axis=1)), np.minimum(high + reach, screen.max(axis=1))
    focal = 0.93 * float(np.min(np.array([columns, rows]) / np.maximum(high - low, 1e-9)))
    return 0.5 * (low + high), focal


def _barycentric(points: Floats, corners: Floats) -> Floats:
    """Weights (N, 3) of the corners (N, 3, 3) of triangles at points (N, 3) on them."""
    a, b, c = (corners[:, i] - points for i in range(3))
    across = np.cross(b - a, c - a)
    weight = np.stack([np.einsum("nj,nj->n", across, np.cross(*two)) for two in ((b, c), (c, a), (a, b))], 1)
    # Rounding can put a point outside, and triangles can be degenerate.
    weight = np.maximum(weight, 0.0) + 1e-300
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _corner_normals(vertices: Floats, faces: Ints32) -> Floats:
    """Normals (F, 3, 3) at the corners of triangles: the vertex normal on smooth surfaces, else the face normal."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    own = np.cross(b - a, c - a)
    shared = np.zeros_like(vertices)
    for axis in range(3):
        shared[:, axis] = np.bincount(faces.ravel(), np.repeat(own[:, axis], 3), len(vertices))
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
    shared /= np.maximum(np.linalg.norm(shared, axis=1, keepdims=True), 1e-300)
    smooth = np.einsum("fij,fj->fi", shared[faces], own) > _CREASE
    return np.where(smooth[..., None], shared[faces], own[:, None])


def _contours(depth: Floats, step: int) -> Floats32:
    """Brightness factors (rows, columns) of eye-dome lighting: pixels with nearer ones `step` pixels away are darker."""
    far = np.log(depth).astype(np.float32)
    padded = np.pad(far, step, constant_values=np.inf)
    hidden = np.zeros_like(far)
    for dy, dx in ((0, 1), (1, 0), (1, 2), (2, 1), (0, 0), (0, 2), (2, 0), (2, 2)):
        neighbour = padded[dy * step : dy * step + far.shape[0], dx * step : dx * step + far.shape[1]]
        with np.errstate(invalid="ignore"):
            hidden += np.nan_to_num(np.maximum(far - neighbour, 0.0), nan=0.0, posinf=0.0)
    return np.exp(-6.0 * np.minimum(hidden / 8, 0.12)).astype(np.float32)
