# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities in closed form as a step of a fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf.config import FitConfig
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.map import queries
from radarsdf.map.contents import MapContents
from radarsdf.returns.rays import Rays
from radarsdf.returns.reflectance import Float32, Reflectance, Residuals
from radarsdf.returns.surfels import Surfels


class ClosedForm:
    """Adds intensities in closed form to a map: before the training, or after it if they are what a network leaves.

    Parameters
    ----------
    rays : Rays
        N returns that the map is learnt from, with ghosts. They are let go before the means of cells are found: of ten
        million, they and what is made of them take half a gigabyte.
    inside : (N',) bool, optional
        Those of the returns of `surface` that `rays` are. None: all.
    surface : SurfaceReturns
        With their surfels.
    config : FitConfig
        Of the fit.
    num_threads : int
        Threads of the fit.
    """

    def __init__(
        self,
        rays: Rays,
        inside: NDArray[np.bool_] | None,
        surface: SurfaceReturns,
        config: FitConfig,
        num_threads: int,
    ) -> None:
        self._after_training = config.trains_intensity
        self._num_threads = num_threads
        self._returns: tuple[Rays, Surfels, NDArray[np.int32]] | None = None
        if rays.intensities is not None and config.closes_intensity:
            cells = surface.surfels.cells.cell_of_ray
            cells = cells if inside is None else cells[inside]
            known = rays.with_intensity
            if known.any() and not known.all():  # a tile may have none: its returns then count as the lowest
                rays, cells = rays.select(known), cells[known]
            self._returns = rays, surface.surfels, cells

    def added(self, contents: MapContents, *, trained: bool) -> MapContents:
        """The contents of the map with intensities in closed form, if it is time for them."""
        if self._returns is None or trained != self._after_training:
            return contents
        residuals = self._residuals(contents, *self._returns)
        self._returns = None
        return dataclasses.replace(contents, reflectance=Reflectance.of(residuals, self._num_threads))

    def _residuals(
        self, contents: MapContents, rays: Rays, surfels: Surfels, cell_of_ray: NDArray[np.int32]
    ) -> Residuals:
        scale = contents.intensity_scale
        assert scale is not None
        assert rays.intensities is not None

        def ask(points: Float32, directions: Float32, ranges_m: Float32) -> Float32:
            sensors = torch.from_numpy(points - directions * ranges_m[:, None])
            return scale.to_unit(queries.intensity(contents, torch.from_numpy(points), sensors).numpy())

        unit = np.nan_to_num(scale.to_unit(rays.intensities), copy=False)
        network = ask if self._after_training else None
        leaf_size_m = contents.config.leaf_size_m
        return Residuals.of(rays, unit, surfels, leaf_size_m, self._num_threads, network, cell_of_ray)
