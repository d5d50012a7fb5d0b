# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Trajectories from above."""

from __future__ import annotations

import io

import numpy as np
import pytest

from ..poses.drift import trajectory


def test_each_trajectory_has_its_colour_and_the_last_one_places_the_returns():
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    image = pytest.importorskip("PIL.Image", reason="matplotlib brings it")
    from radarsdf.render.trajectory_picture import trajectory_picture  # noqa: PLC0415 - after the check

    poses = trajectory(30)
    aside = poses.copy()
    aside[:, 1, 3] += 5
    scans = [np.random.default_rng(0).normal(0, 3, (50, 3))] * 30

    def colours(trajectories):
        pixels = np.asarray(image.open(io.BytesIO(trajectory_picture(scans, trajectories))).convert("RGB"))
        return {f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.unique(pixels.reshape(-1, 3), axis=0)}

    both = colours({"given": poses, "refined": aside})
    assert {"#d95f02", "#1b6ca8", "#b9b9b9"} <= both
    assert "#1b6ca8" not in colours({"found": poses})
