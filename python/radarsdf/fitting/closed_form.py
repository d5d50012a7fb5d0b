# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities in closed form as a step of a fit."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.reflectance import Float32, Reflectance, Residuals


@dataclass(frozen=True)
class ClosedForm:
    """What intensities in closed form are found from."""

    rays: Rays
    """N returns that the map is learnt from, with ghosts. All have intensities, or none has."""
    surfels: Surfels
    """Of all returns."""

    @classmethod
    def of(cls, rays: Rays, surface: SurfaceReturns, config: FitConfig) -> ClosedForm | None:
        """Of `rays`. None: none are asked for or given."""
        if rays.intensities is None or not config.closes_intensity:
            return None
        known = rays.with_intensity
        if known.any() and not known.all():  # a tile may have none: its returns then count as the lowest
            rays = rays.select(known)
        return cls(rays, surface.surfels)

    def added_to(self, contents: MapContents, num_threads: int) -> MapContents:
        """The contents of a map with intensities in closed form: all of them, or what its network leaves."""
        scale = contents.intensity_scale
        assert scale is not None
        assert self.rays.intensities is not None

        def ask(points: Float32, directions: Float32, ranges_m: Float32) -> Float32:
            sensors = torch.from_numpy(points - directions * ranges_m[:, None])
            return scale.to_unit(queries.intensity(contents, torch.from_numpy(points), sensors).numpy())

        unit = np.nan_to_num(scale.to_unit(self.rays.intensities), copy=False)
        network = ask if contents.config.trains_intensity else None
        leaf_size_m = contents.config.leaf_size_m
        residuals = Residuals.of(self.rays, unit, self.surfels, leaf_size_m, network, num_threads)
        return dataclasses.replace(contents, reflectance=Reflectance.of(residuals, num_threads))
