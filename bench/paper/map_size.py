# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Size of a map over the number of scans (figure)."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

from bench.settings import Changes, merged

from .experiment import Experiment, Options, Row, Task, fit, groups, panels
from .report import markdown
from .scenes import Scene

_STEPS = (10, 5, 3, 2, 1)  # of 117 scans, these leave 12, 24, 39, 59 and 117 as in the paper
_BYTES_PER_RETURN = 16  # x, y, z and intensity in float32
_REFERENCE = "SHINE (octree)"
_MAPS: dict[str, tuple[str, Changes, bool]] = {
    _REFERENCE: ("paper", {"encoding": {"kind": "octree", "fourier_count": 0}}, False),
    "3QFPI": ("paper", {}, True),
    "radarsdf": ("default", {}, True),
}


def tasks(scene: Scene, options: Options) -> list[Task]:
    """One task for each number of scans and method."""
    found = []
    for n in _STEPS:
        part = scene.every_nth(n)
        found.append(Task(f"{scene.name}: VDBFusion, {len(part)} scans", partial(_others, part, options)))
        for name in _MAPS:
            found.append(
                Task(f"{scene.name}: {name}, {len(part)} scans", partial(_ours, part, name, options))
            )
    return found


def _others(scene: Scene, options: Options) -> list[Row]:
    common = {"scene": scene.name, "frames": len(scene)}
    result = options.reconstruct("VDBFusion", scene)
    return [
        common | {"method": "point clouds", "bytes": _BYTES_PER_RETURN * sum(map(len, scene.points))},
        common | {"method": "VDBFusion", "bytes": result.map_bytes, "why_not": result.why_not},
    ]


def _ours(scene: Scene, name: str, options: Options) -> list[Row]:
    base, changes, with_intensity = _MAPS[name]
    # The size does not depend on the training, so one iteration is enough.
    short: Changes = {"training": {"sdf_iterations": 1, "intensity_iterations": 1}}
    config = options.config(base, scene, **merged(changes, short))
    if not with_intensity:
        scene = scene.without_intensities()
    radar_map = fit(scene, config)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        radar_map.save(path)
        file_bytes = path.stat().st_size
    row = {"scene": scene.name, "frames": len(scene), "method": name, "bytes": radar_map.nbytes}
    return [row | {"file_bytes": file_bytes}]


def table(rows: list[Row]) -> str:
    """MB of features and weights, in brackets the whole file, and the size relative to the octree."""
    parts = []
    for (scene,), own in groups(rows, "scene").items():
        by_method = groups(own, "method")
        cells = []
        for (method,), same in by_method.items():
            numbers = []
            for row, reference in zip(same, by_method[(_REFERENCE,)], strict=True):
                if row["bytes"] is None:
                    numbers.append("–")
                    continue
                file = f" ({row['file_bytes'] / 1e6:.2f})" if "file_bytes" in row else ""
                numbers.append(
                    f"{row['bytes'] / 1e6:.2f}{file}, {100 * row['bytes'] / reference['bytes']:.0f} %"
                )
            why_not = next((row["why_not"] for row in same if row.get("why_not")), "")
            cells.append([f"{method}: {why_not}" if why_not else method, *numbers])
        columns = [f"{row['frames']} scans" for row in by_method[(_REFERENCE,)]]
        parts += [f"### {scene}: MB, and share of {_REFERENCE}", markdown(["method", *columns], cells)]
    return "\n\n".join(parts)


def plot(rows: list[Row], path: Path) -> None:
    """Size in MB over the number of scans."""
    for ax, own in panels(path, [row for row in rows if row.get("bytes") is not None], "scene"):
        for (method,), same in groups(own, "method").items():
            ax.plot([r["frames"] for r in same], [r["bytes"] / 1e6 for r in same], "o-", ms=3, label=method)
        ax.set(xlabel="scans", ylabel="map, MB")
        ax.grid(alpha=0.3)


EXPERIMENT = Experiment("Map size over the number of scans", ("hugin", "oculii", "wall"), tasks, table, plot)
