# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fit trains, and on how much at a time: decided once, from the configuration and the size of the data."""

from __future__ import annotations

import math
from dataclasses import dataclass

from radarsdf.config import FitConfig

_DROPOUT_HALF_PASSES = 3.0  # each sample seen so often: half of the configured dropout


@dataclass(frozen=True)
class Schedule:
    """Batches and iterations of the two stages; a joint beginning counts in both."""

    batch_size: int
    neighbours: int
    """Rays in a batch that lie side by side."""
    sdf_iterations: int
    intensity_iterations: int
    dropout_scale: float
    """Share of the configured dropout."""
    passes: float
    """How often the SDF network sees each sample."""

    @classmethod
    def of(
        cls, config: FitConfig, *, surface_returns: int, returns: int, vertices: int, with_intensity: bool
    ) -> Schedule:
        """For so many returns of surfaces, and with ghosts, on so many vertices of cells."""
        samples = surface_returns * (config.near_samples + config.free_samples)
        batch_size = config.batch_size
        sdf_iterations = config.sdf_iterations
        if sdf_iterations is None:
            one_pass = samples / batch_size
            # Too few iterations leave the networks unfinished, too many passes learn the noise.
            wanted = max(
                config.sdf_passes * one_pass,
                min(config.enough_sdf_iterations, config.max_sdf_passes * one_pass),
            )
            wanted = min(wanted, config.max_samples_per_vertex * vertices / batch_size)
            sdf_iterations = max(config.min_sdf_iterations, math.ceil(wanted))
            if sdf_iterations > config.max_sdf_iterations:
                # As many samples in larger batches: in a map so large they do not get into each other's way.
                batch_size = math.ceil(batch_size * sdf_iterations / config.max_sdf_iterations)
                sdf_iterations = config.max_sdf_iterations
        # As many places as the usual batch has, but each seen by several rays, which share what they fetch.
        neighbours = batch_size // config.batch_size
        passes = sdf_iterations * batch_size / samples
        if not with_intensity:
            return cls(batch_size, neighbours, sdf_iterations, 0, 0.0, passes)
        samples = returns * config.near_samples
        intensity_iterations = config.intensity_iterations
        if intensity_iterations is None:
            # Larger batches of a joint beginning have shown the network as many samples as more of the usual ones.
            joint = sdf_iterations if config.joint else 0
            near = batch_size * config.near_samples / (config.near_samples + config.free_samples)
            left = config.intensity_passes * samples - joint * max(near, config.intensity_batch_size)
            alone = max(0, math.ceil(left / config.intensity_batch_size))
            wanted = joint + min(alone, config.max_reflectance_iterations)
            intensity_iterations = max(config.min_intensity_iterations, wanted)
        # Where each sample is seen often, there is more to learn by heart. The same dropout for all (0.7 and 0.2) would
        # be as good on sparse scenes, and cost 2 % on a dense one, whose samples are seen twice.
        times_seen = intensity_iterations * config.intensity_batch_size / samples
        dropout_scale = times_seen / (times_seen + _DROPOUT_HALF_PASSES)
        return cls(batch_size, neighbours, sdf_iterations, intensity_iterations, dropout_scale, passes)

    @property
    def iterations(self) -> dict[str, int]:
        """By stage, for reports."""
        return {"sdf": self.sdf_iterations, "intensity": self.intensity_iterations}
