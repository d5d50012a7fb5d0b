# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Positions beyond all use are refused where one is asked for, and no map is handed over that cannot be loaded."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.evaluation import surface_metrics

FAR = (1e13, -1e300, np.inf)


@pytest.mark.parametrize("far", FAR)
def test_a_viewpoint_beyond_all_positions_is_refused(radar_map, far):
    with pytest.raises(ValueError, match=r"viewpoint must be .* within 1e\+12 m"):
        radar_map.mesh(viewpoint=[far, 0, 0])


@pytest.mark.parametrize("far", FAR)
def test_a_box_beyond_all_positions_is_refused(radar_map, far):
    box = [[min(far, 0)] * 3, [max(far, 0)] * 3]
    with pytest.raises(ValueError, match=r"box must be finite, and within 1e\+12 m"):
        radar_map.mesh(box=box)
    with pytest.raises(ValueError, match=r"box must be finite, and within 1e\+12 m"):
        surface_metrics(radar_map.mesh(), [[0, 0, 0]], box=box)


@pytest.mark.parametrize("iterations", [1, 99, 150])
def test_the_map_of_a_divergence_can_be_saved_and_loaded(scene, tmp_path, iterations):
    config = FitConfig(
        training={
            "learning_rate": 1e30,
            "intensity_learning_rate": 1e30,
            "cosine_schedule": False,
            "sdf_iterations": iterations,
            "intensity_iterations": iterations + 2,
            "batch_size": 256,
        }
    )
    with pytest.raises(radarsdf.Diverged) as stop:
        radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    stop.value.radar_map.save(tmp_path / "map.safetensors")
    radarsdf.load(tmp_path / "map.safetensors")


def test_what_load_would_refuse_is_not_saved(scene, tmp_path):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False)
    path = tmp_path / "map.safetensors"
    radar_map.save(path)
    before = path.read_bytes()
    radar_map.field.distances_m[3] = np.nan
    with pytest.raises(ValueError, match="distances_m of the map holds something other than finite numbers"):
        radar_map.save(path)
    assert path.read_bytes() == before
