# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Widths and sizes of encodings and networks, as functions of the configuration alone."""

from __future__ import annotations

import itertools

from radarsdf._core import FEATURE_DIM, NUM_SPHERICAL_HARMONICS
from radarsdf.config.fit_config import FitConfig


def cells_width(config: FitConfig) -> int:
    """Width of the encoding by the cells. A tri-quadtree puts levels side by side, an octree adds them."""
    return FEATURE_DIM * (config.encoding.num_levels if config.encoding.kind == "tri-quadtree" else 1)


def fourier_width(config: FitConfig) -> int:
    """Width of the Fourier encoding: sine and cosine of three coordinates for each frequency."""
    return 6 * config.encoding.fourier_count


def sdf_widths(config: FitConfig) -> tuple[int, ...]:
    """Widths of the input, the hidden layers and the output of the SDF network."""
    networks = config.networks
    inputs = cells_width(config) + fourier_width(config)
    return (inputs, *networks.sdf_hidden, 1 + networks.geometry_feature_dim)


def intensity_widths(config: FitConfig) -> tuple[int, ...]:
    """Widths of the input, the hidden layers and the output of the intensity network."""
    networks = config.networks
    inputs = (
        cells_width(config)
        + fourier_width(config)
        + networks.geometry_feature_dim
        + networks.sdf_input
        + 3 * networks.normals
        + NUM_SPHERICAL_HARMONICS * networks.view_direction
        + networks.log_range
    )
    return (inputs, *networks.intensity_hidden, 1)


def weights_of(widths: tuple[int, ...]) -> int:
    """Number of weights of a network without its biases. So many multiplications it takes for one point."""
    return sum(inputs * outputs for inputs, outputs in itertools.pairwise(widths))


def parameters_of(widths: tuple[int, ...]) -> int:
    """Number of weights and biases of a network."""
    return weights_of(widths) + sum(widths[1:])
