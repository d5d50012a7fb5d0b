"""Pictures: occlusion, no holes, and colours that match the colour bar."""

import sys

import numpy as np
import pytest
import trimesh
from radarsdf.map.colors import Scale
from radarsdf.render.picture import render, save_picture

WHITE = np.array([255, 255, 255])


def square(center, size=2.0, cells=1):
    """A square facing -y, upright."""
    t = np.linspace(-size / 2, size / 2, cells + 1)
    x, z = np.meshgrid(t, t, indexing="ij")
    vertices = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3) + center
    i = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def one_color(mesh, color):
    return np.tile(np.array([*color, 255], dtype=np.uint8), (len(mesh.vertices), 1))


def test_color_map_limits_and_nan():
    c = Scale(45.0, 102.0)([-5.0, 45.0, 73.5, 102.0, 500.0, np.inf, np.nan])
    assert (c[0] == c[1]).all()
    assert (c[3] == c[4]).all()
    assert (c[3] == c[5]).all()
    assert len({tuple(row) for row in c.tolist()}) == 4  # low, middle, high, unknown
    assert np.ptp(c[6]) < 20  # grey
    np.testing.assert_array_equal(Scale(7.0, 7.0)([7.0]), Scale(0.0, 1.0)([0.5]))


@pytest.mark.parametrize("cells", [1, 7, 150])
def test_a_square_is_drawn_without_holes(cells):
    mesh = square((5e6, 3e5, 40.0), size=2.3, cells=cells)  # so far out that float32 would distort it
    color = (200, 40, 40)
    image = render(mesh, one_color(mesh, color), width=300, height=200, viewpoint=(5e6, 3e5 - 10.0, 40.0))
    assert image.shape == (200, 300, 3)
    rows, columns = np.nonzero((image != WHITE).any(axis=-1))
    side = np.ptp(rows) + 1
    assert side == pytest.approx(0.93 * 200, abs=3)
    assert abs(int(np.ptp(columns)) + 1 - side) <= 1  # still a square
    inside = image[rows.min() + 8 : rows.max() - 8, columns.min() + 8 : columns.max() - 8].reshape(-1, 3)
    assert (np.ptp(inside.astype(int), axis=0) <= 2).all()  # one colour: no hole, no seam
    hue = inside[0] / inside[0].max()
    np.testing.assert_allclose(hue, np.array(color) / 200, atol=0.02)


def test_the_nearer_surface_hides_the_farther():
    # Two crossing walls: each occludes the other on one side of the picture.
    a, b = square((0.0, 0.0, 0.0), size=4.0), square((0.0, 0.0, 0.0), size=4.0)
    a.apply_transform(trimesh.transformations.rotation_matrix(0.5, [0, 0, 1]))
    b.apply_transform(trimesh.transformations.rotation_matrix(-0.5, [0, 0, 1]))
    colors = np.vstack([one_color(a, (0, 200, 0)), one_color(b, (200, 0, 0))])
    walls = trimesh.util.concatenate([a, b])
    image = render(walls, colors, width=200, height=200, viewpoint=(0, -9, 0)).astype(int)
    assert image[100, 60, 1] > image[100, 60, 0]
    assert image[100, 140, 0] > image[100, 140, 1]


def test_objects_behind_the_viewer_are_not_drawn():
    room = trimesh.creation.box((10.0, 10.0, 4.0)).subdivide().subdivide().subdivide()
    image = render(room, width=160, height=100, viewpoint=(0.0, -4.0, 0.5))
    assert (image != WHITE).any(axis=-1).mean() > 0.5
    ahead, behind = square((0.0, -40.0, 0.0)), square((0.0, 0.0, 0.0))
    colors = np.vstack([one_color(ahead, (200, 0, 0)), one_color(behind, (0, 200, 0))])
    mesh = trimesh.util.concatenate([ahead, behind])
    image = render(mesh, colors, width=160, height=100, viewpoint=(0.0, -10.0, 0.0)).astype(int)
    assert (image[..., 0] > image[..., 1]).any()
    assert not (image[..., 1] > image[..., 0]).any()
    half = trimesh.Trimesh([[-1, -5, -1], [1, -5, -1], [0, 20, -1]], [[0, 1, 2]], process=False)
    assert (render(half, width=160, height=100, viewpoint=(0.0, 0.0, 0.0)) == WHITE).all()


def test_from_straight_above_north_is_at_the_top():
    """Four squares on the ground, to the east, north, west and south, and a viewer in the middle who looks north."""
    squares = [square((0, 0, 0)) for _ in range(4)]
    for number, tile in enumerate(squares):
        tile.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        tile.apply_translation(3 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])[number])
    colors = [(200, 0, 0), (0, 200, 0), (0, 0, 200), (200, 200, 0)]
    shown = np.vstack([one_color(tile, color) for tile, color in zip(squares, colors, strict=True)])
    mesh = trimesh.util.concatenate(squares)
    image = render(mesh, shown, width=200, height=200, viewpoint=(0, 0, 20)).astype(int)
    places = [(100, 170), (30, 100), (100, 30), (170, 100)]  # row and column
    for (row, column), color in zip(places, colors, strict=True):
        np.testing.assert_array_equal(image[row, column] > image[row, column].max() / 2, np.array(color) > 0)
    walls = trimesh.util.concatenate([square((0, 9, 0)), square((0, -9, 0))])
    shown = np.vstack([one_color(square((0, 0, 0)), color) for color in colors[:2]])
    middle = render(walls, shown, width=60, height=40, viewpoint=(0, 0, 0))[20, 30].astype(int)
    assert middle[0] > middle[1]  # the northern wall


def test_save_picture_has_the_colors_of_the_scalar(tmp_path):
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread  # noqa: PLC0415

    mesh = square((0.0, 0.0, 0.0), cells=20)
    scalar = np.where(mesh.vertices[:, 0] < 0, 60.0, 80.0)
    scalar[:5] = np.nan
    path = tmp_path / "map.png"
    save_picture(
        path, mesh, scalar=scalar, label="intensity [dB]", width=500, height=300, viewpoint=(0, -5, 0)
    )
    image = np.rint(imread(path)[..., :3] * 255)
    assert image.shape == (300, 500, 3)
    low, high = Scale(60.0, 80.0)([60.0, 80.0]).astype(float)
    for column, color in ((150, low), (300, high)):
        shade = image[150, column] / color
        assert np.ptp(shade) < 0.06  # the colour, darker or brighter by the light
    bar = image[:, 460:466].reshape(-1, 3)
    assert np.abs(bar - low).sum(axis=1).min() < 10
    assert np.abs(bar - high).sum(axis=1).min() < 10
    plain = tmp_path / "plain.png"
    save_picture(plain, mesh, width=200, height=100)
    assert (imread(plain)[..., :3] < 0.9).any()


def test_without_matplotlib_the_error_names_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"] + ["matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match='pip install "matplotlib>='):
        save_picture(tmp_path / "map.png", square((0.0, 0.0, 0.0)))


def test_the_last_trajectory_places_the_returns(tmp_path):
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from matplotlib.image import imread  # noqa: PLC0415
    from radarsdf.render.figures import save_trajectory_picture  # noqa: PLC0415

    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = np.arange(30)
    aside = poses + 5 * np.eye(4)[1][:, None] * np.eye(4)[3]
    scans = [np.random.default_rng(0).normal(0, 3, (50, 3))] * 30

    def colors(trajectories):
        save_trajectory_picture(tmp_path / "poses.png", scans, trajectories)
        pixels = np.rint(imread(tmp_path / "poses.png")[..., :3] * 255).astype(int)
        return {"#{:02x}{:02x}{:02x}".format(*color) for color in np.unique(pixels.reshape(-1, 3), axis=0)}

    assert {"#d95f02", "#1b6ca8", "#b9b9b9"} <= colors({"given": poses, "refined": aside})
    assert "#1b6ca8" not in colors({"found": poses})


def test_a_grid_is_drawn_at_its_position(tmp_path, monkeypatch):
    """A floor with a block on it: heights, costs, occupancy and clearance, x to the right and y up, NaN where unknown."""
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.grids.grid import Grid  # noqa: PLC0415
    from radarsdf.render import figures  # noqa: PLC0415

    state = np.zeros((12, 8, 9), np.int8)
    state[:, :, 0] = state[3:5, 5:7, 1:4] = 1
    state[10:] = -1
    above_m = np.broadcast_to(0.5 * np.arange(9, dtype=np.float32) - 0.25, state.shape)
    grid = Grid(np.array([100.0, -20.0, 3.0]), 0.5, state, np.full_like(above_m, 0.5), above_m, 0.0)
    drawn, png_of = [], figures.png_of
    monkeypatch.setattr(figures, "png_of", lambda figure: drawn.append(figure) or png_of(figure))
    figures.save_grid_picture(tmp_path / "grid.png", grid, 0.3, 2.0)
    assert (tmp_path / "grid.png").read_bytes().startswith(b"\x89PNG")
    axes = [ax for ax in drawn[0].axes if ax.images]
    costs, level = grid.costmap(), int(np.argmax(grid.free.sum(axis=(0, 1))))
    distance_m = grid.distances().not_free_m[:, :, level]
    flat = grid.flat(0.3, 2.0).state
    expected = [
        costs.height_m, np.where(costs.cost < 0, np.nan, costs.cost), np.where(flat < 0, np.nan, flat),
        np.where(distance_m > 0, distance_m, np.nan),
    ]  # fmt: skip
    for ax, values in zip(axes, expected, strict=True):
        (image,) = ax.images
        np.testing.assert_array_equal(np.ma.filled(image.get_array(), np.nan), np.float32(values).T)
        assert image.get_extent() == [100.0, 106.0, -20.0, -16.0]
        assert image.origin == "lower"
    assert axes[3].get_title() == f"clearance at z = {3 + (level + 0.5) * 0.5:.1f} m, m"
