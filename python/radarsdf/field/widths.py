# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How many numbers the networks see and hold: worked out here alone, for the networks, the estimate and the training."""

from __future__ import annotations

import itertools

from radarsdf._core import FEATURE_DIM, NUM_SPHERICAL_HARMONICS
from radarsdf.config import FitConfig


def cells_width(config: FitConfig) -> int:
    """Numbers of a point's encoding by the features of its cells: levels are concatenated on planes, summed in space."""
    return FEATURE_DIM * (config.encoding.num_levels if config.encoding.kind == "tri-quadtree" else 1)


def fourier_width(config: FitConfig) -> int:
    """Numbers of a point's Fourier encoding: sine and cosine of three coordinates."""
    return 6 * config.encoding.fourier_count


def sdf_widths(config: FitConfig) -> tuple[int, ...]:
    """Inputs, hidden layers and outputs of the SDF network."""
    networks = config.networks
    inputs = cells_width(config) + fourier_width(config)
    return (inputs, *networks.sdf_hidden, 1 + networks.geometry_feature_dim)


def intensity_widths(config: FitConfig) -> tuple[int, ...]:
    """Inputs, hidden layers and output of the intensity network."""
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
    """Weights of a network, without its biases: also the multiplications that it takes for one point."""
    return sum(inputs * outputs for inputs, outputs in itertools.pairwise(widths))


def parameters_of(widths: tuple[int, ...]) -> int:
    """Weights and biases of a network."""
    return weights_of(widths) + sum(widths[1:])
