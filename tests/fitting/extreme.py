"""Training with extreme settings or for very long: a map stays finite, or the fit raises `Diverged`."""

from typing import Any

import numpy as np
import radarsdf
from radarsdf import Diverged, FitConfig, RadarMap

from scenes.settings import Changes, merged

CASES: dict[str, Changes] = {
    "default": {},
    **{f"learning rates {r:g}": {"training": {"learning_rate": r, "intensity_learning_rate": r}} for r in
       (1e-4, 1e-1, 1.0)},
    "learning rates 1, constant": {
        "training": {"learning_rate": 1.0, "intensity_learning_rate": 1.0, "optimiser": "adam"}
    },
    # 1 mm and 10 m.
    **{f"sigma of {s:g} cells": {"training": {"sigma_cells": s}} for s in (0.005, 50.0)},
    # Saturated labels of many sigmas, and large logits.
    "saturated": {"training": {"sigma_cells": 0.005, "learning_rate": 0.1}},
    "batches of one": {"training": {"batch_size": 1, "intensity_batch_size": 1}},
    "all of 3QFPI": {
        "networks": {"normals": True, "geometry_feature_dim": 15}, "training": {"intensity_in_free_space": True}
    },
    "no dropout": {"networks": {"dropout": False}},
}  # fmt: skip
"""Settings that differ from the default."""


def room() -> tuple[list[Any], Any, list[Any]]:
    """Points, poses and intensities of three scans in a room of 8 m x 8 m x 3 m."""
    rng = np.random.default_rng(0)
    points, poses, intensities = [], np.eye(4)[None].repeat(3, 0), []
    for i, pose in enumerate(poses):
        pose[:3, 3] = [0.2 * i, 0.0, 0.0]
        rays = rng.normal(size=(300, 3))
        walls_m = (np.where(rays > 0, [4, 4, 1.5], [-4, -4, -1.5]) - pose[:3, 3]) / rays
        points.append(rays * walls_m.min(axis=1, keepdims=True))
        intensities.append(60 - 40 * np.log10(np.linalg.norm(points[-1], axis=1)))
    return points, poses, intensities


def fitted(changes: Changes, iterations: int) -> tuple[RadarMap, str]:
    """A map of the room, and how the fit ended.

    Raises
    ------
    AssertionError
        If a number of the map, of a query or of the mesh is not finite.
    """
    config = FitConfig(num_threads=1).override(
        **merged(
            {"returns": {"min_range_m": 0.5}, "training": {"batch_size": 256, "intensity_batch_size": 256}},
            changes,
            {"training": {"sdf_iterations": iterations, "intensity_iterations": 2 * iterations}},
        )
    )
    points, poses, intensities = room()
    radar_map, end = None, "done"
    try:
        radar_map = radarsdf.fit(points, poses, intensities, config=config, progress=False)
    except Diverged as error:
        radar_map, end = error.radar_map, str(error)
    assert radar_map is not None
    assert all(value.isfinite().all() for value in radar_map.field.state_dict().values())
    assert all(np.isfinite(loss) for loss in radar_map.report["losses"].values())
    x = np.random.default_rng(1).uniform(-4.5, 4.5, (2000, 3))
    for values in (
        radar_map.sdf(x, extrapolate=True),
        radar_map.gradient(x, extrapolate=True),
        radar_map.intensity(x, poses[0, :3, 3], extrapolate=True),
    ):
        assert np.isfinite(values).all()
    assert np.isfinite(radar_map.mesh(0.2, progress=False).vertices).all()
    return radar_map, end


def free_and_solid(radar_map: RadarMap) -> tuple[float, float]:
    """Shares of points 0.2 m before walls that are free, and 0.2 m behind that are solid, observed or not."""
    rng = np.random.default_rng(2)
    rays = rng.normal(size=(2000, 3))
    on_wall = rays * (np.array([4, 4, 1.5]) / np.abs(rays)).min(axis=1, keepdims=True)
    outward = np.where(np.isclose(np.abs(on_wall), [4, 4, 1.5]), np.sign(on_wall), 0.0)
    free = float((radar_map.sdf(on_wall - 0.2 * outward, extrapolate=True) > 0).mean())
    return free, float((radar_map.sdf(on_wall + 0.2 * outward, extrapolate=True) < 0).mean())
