"""Draw the figures of how_it_works.md: ``python docs/draw.py`` writes them to docs/figures. It needs the extra `plot`."""

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf.fitting import sampling
from radarsdf.render.figures import new_figure, png_of

SCAN = 3  # the one that is drawn
BOX = (10.0, 45.0, -12.0, 12.0)  # part of the street that is drawn from above: x from, to, y from, to, m
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
        (one, scan_of == SCAN, "one scan"),
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


def draw(folder: Path, frames: int) -> None:
    """Write both figures."""
    folder.mkdir(parents=True, exist_ok=True)
    drive = radarsdf.simulate.hugin(frames=frames)
    returns(drive, folder / "returns.png")
    samples(radarsdf.FitConfig(), folder / "samples.png")
    for path in folder.glob("*.png"):
        small(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures", metavar="FOLDER")
    parser.add_argument("--frames", type=int, default=60, help="scans of the drive")
    options = parser.parse_args()
    draw(options.out, options.frames)
