# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Presets: settings that differ from the defaults, as :meth:`FitConfig.override` takes them."""

from __future__ import annotations

from typing import Any

QUICK: dict[str, Any] = {"train": False, "returns": {"passages": False}}
"""Stage 1 only."""

# 3QFP (ICRA 2024) and 3QFPI, piece by piece.
_SCANS = {"accumulate_scans": 5}
_NO_CLEANING = {"drop_movers": False, "drop_ghosts": False, "onto_planes": False, "passages": False}
_ENCODING = {"bridge_cells": 0, "fourier_count": 16}
_INTENSITY_NETWORK = {
    "intensity_hidden": (64, 64),
    "geometry_feature_dim": 15,
    "normals": True,
    "log_range": False,
    "dropout": False,
    "reflectance": "network",
}
_LOSSES = {
    "sigma_cells": 0.1375,
    "intensity_in_free_space": True,
    "cross_range_noise_rad": 0.0,
}  # 0.55 · 0.05 m
_BATCHES = {"batch_size": 8192, "intensity_batch_size": 8192}
_ITERATIONS = {"sdf_iterations": 1000, "intensity_iterations": 4000}
_ADAM = {
    "optimiser": "adam",
    "learning_rate": 1e-3,
    "intensity_learning_rate": 1e-3,
    "cosine_schedule": False,
    "row_updates": False,
}

PAPER: dict[str, Any] = {
    "returns": _SCANS | _NO_CLEANING,
    "encoding": _ENCODING,
    "networks": _INTENSITY_NETWORK,
    "training": _LOSSES | _BATCHES | _ITERATIONS | _ADAM,
}
"""3QFPI as published."""
