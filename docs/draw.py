"""Draws the figures of the pages: ``python docs/draw.py`` writes them to docs/figures.

All but `changes.png` are of one simulated drive and one fit of it. It takes half a minute and needs the extra `plot`.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf.changes.changes import APPEARED, COLORS, GONE, MOVED, NAMES, SAME, UNSEEN
from radarsdf.fitting import sampling
from radarsdf.render.figures import new_figure, png_of, save_view_picture
from radarsdf.render.picture import render, save_picture
from radarsdf.simulate import Box, Scene, simulate
from radarsdf.simulate.materials import CONCRETE

HELD_OUT = 3  # the scan that is predicted
BOX = (10.0, 45.0, -12.0, 12.0)  # part of the street that is drawn from above: x from, to, y from, to, m
SIZE = {"width": 1200, "height": 560}
TAKEN, PUT = (2.5, 2.5, 0.5), (2.5, -3.0, 0.5)  # centres of a box that goes and of one that comes, m
ROUND_BOXES = [[-3.0, -6.0, -0.5], [12.0, 6.0, 3.0]]
LIGHT, DARK, RED, BLUE = "#b9c2cc", "#2c3e50", "#c0392b", "#1f5a96"


def small(path: Path) -> None:
    """Reduce a picture to 256 colours: a third of the bytes."""
    from PIL import Image  # noqa: PLC0415 - it comes with matplotlib

    packed = io.BytesIO()
    Image.open(path).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE).save(
        packed, "PNG", optimize=True
    )
    path.write_bytes(packed.getvalue())


def returns(drive: Any, path: Path) -> None:
    """One scan and all scans, from above; what is no surface in red."""
    figure = new_figure(figsize=(12, 4.4), layout="constrained")
    one, every = figure.subplots(1, 2, sharex=True, sharey=True)
    counts = [len(scan) for scan in drive.points]
    scan_of = np.repeat(np.arange(len(drive)), counts)
    world, true = drive.world_points(), drive.is_surface()
    for axes, chosen, title in (
        (one, scan_of == HELD_OUT, "one scan"),
        (every, np.full(len(true), True), f"{len(drive)} scans, moved by their poses"),
    ):
        for kind, color, label in ((true, DARK, "from a surface"), (~true, RED, "ghosts and clutter")):
            at = world[chosen & kind]
            axes.plot(at[:, 0], at[:, 1], ".", ms=1.5, color=color, label=label)
        axes.set(title=title, xlabel="x, m", ylabel="y, m", aspect="equal", xlim=BOX[:2], ylim=BOX[2:])
    one.legend(markerscale=6, loc="lower right", fontsize=8)
    path.write_bytes(png_of(figure, dpi=100))


def samples(config: radarsdf.FitConfig, path: Path) -> None:
    """Where samples lie on one ray, and what they are told."""
    figure = new_figure(figsize=(12, 3.0), layout="constrained")
    axes = figure.subplots()
    range_m, rng = 3.0, np.random.default_rng(1)
    x = np.linspace(0, range_m + 1.2, 500)
    occupied = 1 / (1 + np.exp((range_m - x) / config.sigma_m))
    axes.plot(x, occupied, color=BLUE, label="label: probability that the point is behind the surface")
    near = range_m + rng.uniform(-1, 1, sampling.NEAR_SAMPLES) * config.metres(sampling.NEAR_BAND_CELLS)
    free = rng.uniform(
        sampling.FREE_FROM * range_m,
        range_m + config.metres(sampling.FREE_BEYOND_CELLS),
        sampling.FREE_SAMPLES,
    )
    axes.plot(free, np.full(len(free), -0.12), "o", color=LIGHT, label="samples along the ray")
    axes.plot(near, np.full(len(near), -0.12), "o", color=DARK, label="samples near the return")
    axes.plot([0, range_m], [-0.12] * 2, color=LIGHT, lw=1, zorder=0)
    axes.plot(0, -0.12, ">", color=BLUE, ms=10)
    axes.plot(range_m, -0.12, "*", color=RED, ms=14, label="the return")
    axes.set(xlabel="distance from the sensor, m", ylim=(-0.25, 1.05), xlim=(-0.1, range_m + 1.2))
    axes.legend(loc="center left", fontsize=8)
    path.write_bytes(png_of(figure, dpi=100))


def field(radar_map: radarsdf.RadarMap, height_m: float, path: Path) -> None:
    """A slice of the signed distance, and the surface in it."""
    figure = new_figure(figsize=(9, 5.0), layout="constrained")
    axes = figure.subplots()
    x, y = np.arange(BOX[0], BOX[1], 0.05), np.arange(BOX[2], BOX[3], 0.05)
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height_m)], -1).reshape(-1, 3)
    sdf = np.where(radar_map.observed(grid), radar_map.sdf(grid), np.nan).reshape(len(y), len(x))
    shown = axes.pcolormesh(x, y, sdf, cmap="RdBu", vmin=-0.4, vmax=0.4, rasterized=True)
    axes.contour(x, y, sdf, [0.0], colors="black", linewidths=1.0)
    axes.set(
        title=f"signed distance {height_m:.1f} m above the world's origin",
        aspect="equal",
        xlabel="x, m",
        ylabel="y, m",
    )
    figure.colorbar(shown, label="m: blue in free space, red behind", shrink=0.8)
    path.write_bytes(png_of(figure, dpi=100))


def changes(frames: int, path: Path) -> None:
    """What two drives past a wall tell of two boxes."""
    first = radarsdf.simulate.wall(frames=frames)
    beside = first.poses.copy()
    beside[:, 1, 3] += 0.3
    maps = []
    for day, (poses, center) in enumerate(((first.poses, TAKEN), (beside, PUT))):
        box = Box(np.array(center), np.full(3, 0.5), 0.3, CONCRETE)
        scene = Scene([*first.scene.solids, box], first.scene.terrain)
        drive = simulate(scene, first.sensor, poses, name="wall", seed=day)
        config = radarsdf.FitConfig.quick(returns={"free_space": True})
        maps.append(radarsdf.fit(drive.points, drive.poses, config=config))
    mesh = radarsdf.compare(*maps, box=ROUND_BOXES).mesh()
    figure = new_figure(figsize=(12, 5.6), facecolor="white")
    figure.figimage(render(mesh, mesh.visual.vertex_colors, **SIZE), 0, 0)
    for row, kind in enumerate((APPEARED, GONE, MOVED, SAME, UNSEEN)):
        figure.text(0.02, 0.92 - 0.06 * row, "\u25a0", color=np.array(COLORS[kind]) / 255, size=15)
        figure.text(0.04, 0.92 - 0.06 * row, NAMES[kind], size=15)
    path.write_bytes(png_of(figure, dpi=100))


def draw(folder: Path, frames: int) -> None:
    """Write all figures."""
    folder.mkdir(parents=True, exist_ok=True)
    drive = radarsdf.simulate.hugin(frames=frames)
    kept = [i for i in range(len(drive)) if i != HELD_OUT]
    points, intensities = ([list_[i] for i in kept] for list_ in (drive.points, drive.intensities))
    radar_map = radarsdf.fit(points, drive.poses[kept], intensities)
    mesh = radar_map.mesh(0.1, viewpoint=drive.poses[0, :3, 3])
    answers = mesh.vertex_attributes

    returns(drive, folder / "returns.png")
    samples(radar_map.config, folder / "samples.png")
    field(radar_map, drive.poses[0, 2, 3], folder / "field.png")
    save_picture(folder / "surface.png", mesh, **SIZE)
    save_picture(folder / "reflectance.png", mesh, scalar=answers["intensity"], label="intensity, dB", **SIZE)
    save_picture(
        folder / "uncertainty.png", mesh, scalar=answers["uncertainty_m"], label="uncertainty, m", **SIZE
    )
    measured = np.column_stack([drive.points[HELD_OUT], drive.intensities[HELD_OUT]])
    save_view_picture(folder / "view.png", [radar_map.render(drive.poses[HELD_OUT])], [measured])
    for path in folder.glob("*.png"):
        small(path)
    changes(min(frames, 24), folder / "changes.png")  # fewer colours would tint its greys


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures", metavar="FOLDER")
    parser.add_argument("--frames", type=int, default=60, help="scans of the drive")
    options = parser.parse_args()
    draw(options.out, options.frames)
