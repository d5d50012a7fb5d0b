# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The learnt field: encodings and networks. Positions are local, intensities scaled to [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from radarsdf.config.fit_config import FitConfig
from radarsdf.field.encodings import Fourier, Octree, TriQuadtree
from radarsdf.field.networks import IntensityNetwork, SDFNetwork


@dataclass(frozen=True)
class Geometry:
    """Inputs and outputs of the SDF network at N points."""

    encoding: tuple[Tensor, ...]
    """Inputs, (N, width) each: the encoding by the cells, then the Fourier encoding if there is one."""
    logit: Tensor
    """(N,) signed distance / sigma, positive in free space."""
    feature: Tensor
    """(N, geometry_feature_dim), an input of the intensity network."""
    normals: Tensor | None
    """(N, 3) unit vectors towards free space. None if the intensity network does not use them."""

    def first(self, count: int) -> Geometry:
        """The part for the first `count` points."""
        normals = None if self.normals is None else self.normals[:count]
        encoding = tuple(part[:count] for part in self.encoding)
        return Geometry(encoding, self.logit[:count], self.feature[:count], normals)


class Field(nn.Module):
    """Signed distance, and if there are intensities also intensity, at points of the local frame.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) uint64, Morton keys of the occupied leaf cells, ascending (``CellSet.sorted_keys``).
    config : FitConfig
        Its encoding, its networks and its lengths are used.
    with_intensity : bool
        Whether the field has an intensity network.
    num_threads : int
        Threads that build the table of vertices. 0: as many as OpenMP uses.
    """

    def __init__(
        self, leaf_keys: NDArray[np.uint64], config: FitConfig, *, with_intensity: bool, num_threads: int = 0
    ) -> None:
        super().__init__()
        encoding = TriQuadtree if config.encoding.kind == "tri-quadtree" else Octree
        self.sigma_m = config.sigma_m
        self.cells = encoding(leaf_keys, config.leaf_size_m, config.encoding.num_levels, num_threads)
        self.fourier = Fourier(config.fourier_half_width_m, config.encoding.fourier_count)
        self.sdf_network = SDFNetwork(config)
        self.intensity_network = IntensityNetwork(config) if with_intensity else None

    def initialise(self, generator: torch.Generator, *, features: bool = True) -> None:
        """Draws the weights of the networks, then the features (3QFP). `features` False: they stay zero."""
        self.sdf_network.initialise(generator)
        if self.intensity_network is not None:
            self.intensity_network.initialise(generator)
        if features:
            self.cells.initialise(generator)

    def encode(self, points: Tensor, interpolated: Tensor | None = None) -> tuple[Tensor, ...]:
        """The inputs of the SDF network, (N, width) each, at points (N, 3), local frame, m.

        `interpolated`: the features of the cells at the points, (N, interpolated_dim), if they are known
        already.
        """
        cells = self.cells(points) if interpolated is None else self.cells.combine(interpolated)
        return (cells, self.fourier(points)) if self.fourier.num_frequencies else (cells,)

    def logit(self, points: Tensor, interpolated: Tensor | None = None) -> Tensor:
        """Signed distance / sigma (N,), positive in free space. `interpolated`: see :meth:`encode`."""
        return self.sdf_network(self.encode(points, interpolated))[0]  # type: ignore[no-any-return]

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,), m, positive in free space, at points (N, 3), local frame, m."""
        return self.logit(points) * self.sigma_m

    def geometry(
        self, points: Tensor, *, frozen: bool = True, interpolated: Tensor | None = None
    ) -> Geometry:
        """The inputs of the intensity network at points (N, 3), local frame, m.

        `frozen`: no gradient reaches features and SDF network. `interpolated`: see :meth:`encode`.
        """
        wants_normals = self.intensity_network is not None and self.intensity_network.normals
        # A normal is the gradient of the logit, so it needs an autograd graph even if the field is frozen.
        with torch.set_grad_enabled((torch.is_grad_enabled() and not frozen) or wants_normals):
            if wants_normals:
                points = points.detach().requires_grad_()
            encoding = self.encode(points, interpolated)
            logit, feature = self.sdf_network(encoding)
            normals = None
            if wants_normals:
                (gradient,) = torch.autograd.grad(logit.sum(), points, create_graph=not frozen)
                normals = functional.normalize(gradient, dim=1)
        if frozen:
            encoding = tuple(part.detach() for part in encoding)
            logit, feature = logit.detach(), feature.detach()
        return Geometry(encoding, logit, feature, normals)

    def intensity(
        self,
        geometry: Geometry,
        directions: Tensor,
        ranges_m: Tensor,
        *,
        encoding_factors: Sequence[Tensor] | None = None,
    ) -> Tensor:
        """Scaled intensity (N,).

        Parameters
        ----------
        geometry : Geometry
            The result of :meth:`geometry` at the N points.
        directions, ranges_m : Tensor
            As for :class:`~radarsdf.field.networks.IntensityNetwork`.
        encoding_factors : sequence of Tensor, optional
            Dropout: what each part of the encoding is multiplied by, of the same shapes.
        """
        assert self.intensity_network is not None
        encoding = geometry.encoding
        if encoding_factors is not None:
            encoding = tuple(part * kept for part, kept in zip(encoding, encoding_factors, strict=True))
        return self.intensity_network(  # type: ignore[no-any-return]
            encoding, geometry.logit, geometry.feature, geometry.normals, directions, ranges_m
        )
