# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fit trains, and on how much at a time: decided once, from the configuration and the size of the data."""

from __future__ import annotations

import math
from dataclasses import dataclass

from radarsdf.config import FitConfig

# The geometry sees each sample once, but at least _ENOUGH and _LEAST iterations, as far as the other limits let it.
_LEAST_SDF_ITERATIONS = 150  # fewer leave the surface of a small scene unfinished
# Fewer iterations leave the networks unconverged. Measured: 0.8 points of F-score on hugin(seed=1, frames=30), 0.3 on a
# real scene.
_ENOUGH_SDF_ITERATIONS = 300
# Samples of few returns are not seen more often: the noise is memorised. Measured: 3 passes cost 0.6 points of F-score on
# oculii(seed=1, frames=40), 13 passes 1.4 on a tenth of oculii.
_MOST_SDF_PASSES = 2.0
_MOST_SAMPLES_PER_VERTEX = 32.0  # measured: wall, which has 100 in a pass, is as good after 20
_MOST_SDF_ITERATIONS = 5000  # then batches grow instead: a usual batch hardly touches so large a map

# The intensity network sees each near sample once, within these limits.
_LEAST_INTENSITY_ITERATIONS = 1200  # fewer leave the reflectance of a small scene unfinished
# On the finished geometry. Measured on 2 million returns of hugin: 174, 974, 2974 and 4288 iterations end at errors of
# 2.89, 2.83, 2.80 and 2.80 dB.
_MOST_INTENSITY_ITERATIONS = 4000

_HALF_DROPOUT_PASSES = 3.0  # where each sample is seen so often, half of the configured dropout is used


@dataclass(frozen=True)
class Schedule:
    """Batches and iterations of geometry and intensity. A joint beginning counts in both."""

    batch_size: int
    """Samples in an iteration of the geometry."""
    neighbours: int
    """Rays in a batch that lie side by side."""
    sdf_iterations: int
    """Iterations of the geometry."""
    intensity_iterations: int
    """Iterations of the intensity network."""
    dropout_scale: float
    """Share of the configured dropout."""
    passes: float
    """How often the geometry sees each sample."""

    @classmethod
    def of(
        cls, config: FitConfig, *, surface_returns: int, returns: int, vertices: int, with_intensity: bool
    ) -> Schedule:
        """For so many returns without ghosts, and with them, on so many vertices of cells."""
        sampling, training = config.sampling, config.training
        samples = surface_returns * (sampling.near_samples + sampling.free_samples)
        batch_size, sdf_iterations = training.batch_size, training.sdf_iterations
        if sdf_iterations is None:
            batch_size, sdf_iterations = _geometry(config, samples, vertices)
        # As many places as the usual batch has, but each seen by several rays, which share what they fetch.
        neighbours = batch_size // training.batch_size
        passes = sdf_iterations * batch_size / samples
        if not with_intensity:
            return cls(batch_size, neighbours, sdf_iterations, 0, 0.0, passes)
        samples = returns * sampling.near_samples
        intensity_iterations = training.intensity_iterations
        if intensity_iterations is None:
            intensity_iterations = _intensity(config, samples, batch_size, sdf_iterations)
        # A sample that is seen often is more easily memorised. The same dropout for all (0.7 and 0.2) would be as good on
        # sparse scenes, and cost 2 % on a dense one, whose samples are seen twice.
        times_seen = intensity_iterations * training.intensity_batch_size / samples
        dropout_scale = times_seen / (times_seen + _HALF_DROPOUT_PASSES)
        return cls(batch_size, neighbours, sdf_iterations, intensity_iterations, dropout_scale, passes)

    @property
    def iterations(self) -> dict[str, int]:
        """Of both, for reports."""
        return {"sdf": self.sdf_iterations, "intensity": self.intensity_iterations}


def _geometry(config: FitConfig, samples: int, vertices: int) -> tuple[int, int]:
    """Samples in a batch, and iterations of the geometry."""
    batch_size = config.training.batch_size
    one_pass = samples / batch_size
    wanted = max(one_pass, min(_ENOUGH_SDF_ITERATIONS, _MOST_SDF_PASSES * one_pass))
    wanted = min(wanted, _MOST_SAMPLES_PER_VERTEX * vertices / batch_size)
    iterations = max(_LEAST_SDF_ITERATIONS, math.ceil(wanted))
    iterations = max(1, round(config.effort * iterations))
    if iterations <= _MOST_SDF_ITERATIONS:
        return batch_size, iterations
    return math.ceil(batch_size * iterations / _MOST_SDF_ITERATIONS), _MOST_SDF_ITERATIONS


def _intensity(config: FitConfig, samples: int, batch_size: int, sdf_iterations: int) -> int:
    """Iterations of the intensity network, those of a joint beginning included."""
    sampling, training = config.sampling, config.training
    joint = sdf_iterations if training.joint else 0
    # Larger batches of a joint beginning have shown the network as many samples as more of the usual ones.
    near = batch_size * sampling.near_samples / (sampling.near_samples + sampling.free_samples)
    left = samples - joint * max(near, training.intensity_batch_size)
    alone = max(0, math.ceil(left / training.intensity_batch_size))
    wanted = max(_LEAST_INTENSITY_ITERATIONS, joint + min(alone, _MOST_INTENSITY_ITERATIONS))
    return max(1, joint + round(config.effort * (wanted - joint)))
