# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The learnt field: encodings and networks together, in the local frame and in scaled intensities."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from radarsdf.config import FitConfig
from radarsdf.encodings import Fourier, Octree, TriQuadtree
from radarsdf.networks import IntensityNetwork, SDFNetwork


class Field(nn.Module):
    """Signed distance and, where there are intensities, reflectance at points of the local frame.

    Parameters
    ----------
    leaf_keys : ndarray
        (C,) uint64, occupied leaf cells (``CellSet.sorted_keys``).
    config : FitConfig
        Shapes and scales.
    with_intensity : bool
        Whether there is an intensity network at all.
    num_threads : int
        For building the table of cells; 0: as many as OpenMP uses.
    """

    def __init__(
        self, leaf_keys: NDArray[np.uint64], config: FitConfig, *, with_intensity: bool, num_threads: int = 0
    ) -> None:
        super().__init__()
        encoding = TriQuadtree if config.encoding == "tri-quadtree" else Octree
        self.sigma_m = config.sigma_m
        self.cells = encoding(leaf_keys, config.leaf_size_m, config.num_levels, num_threads)
        self.fourier = Fourier(config.fourier_half_width_m, config.fourier_first, config.fourier_count)
        dim = self.cells.dim + self.fourier.dim
        self.sdf_network = SDFNetwork(dim, config)
        self.intensity_network = IntensityNetwork(dim, config) if with_intensity else None

    def encode(self, points: Tensor) -> Tensor:
        """(N, 3) local, m, to (N, D)."""
        return torch.cat([self.cells(points), self.fourier(points)], 1)

    def logit(self, points: Tensor) -> Tensor:
        """Signed distance / sigma (N,), positive in free space."""
        return self.sdf_network(self.encode(points))[0]  # type: ignore[no-any-return]

    def intensity(
        self,
        points: Tensor,
        directions: Tensor,
        ranges_m: Tensor,
        *,
        geometry_frozen: bool = True,
        encoding_factors: Tensor | None = None,
    ) -> Tensor:
        """Scaled intensity (N,); arguments as of :class:`~radarsdf.networks.IntensityNetwork`.

        With `geometry_frozen`, no gradient reaches features and SDF network, and none of their graph is kept. What the
        intensity network sees of the encoding is multiplied by `encoding_factors` (N, D): dropout.
        """
        network = self.intensity_network
        assert network is not None
        normals = None
        # The normal is itself a gradient: where it is wanted, its own graph is needed for a moment.
        with torch.set_grad_enabled((torch.is_grad_enabled() and not geometry_frozen) or network.normals):
            if network.normals:
                points = points.detach().requires_grad_()
            encoding = self.encode(points)
            logit, geometry_feature = self.sdf_network(encoding)
            if network.normals:
                (gradient,) = torch.autograd.grad(logit.sum(), points, create_graph=not geometry_frozen)
                normals = functional.normalize(gradient, dim=1)
        if geometry_frozen:
            encoding, logit, geometry_feature = encoding.detach(), logit.detach(), geometry_feature.detach()
        if encoding_factors is not None:
            encoding = encoding * encoding_factors
        return network(encoding, logit, geometry_feature, normals, directions, ranges_m)  # type: ignore[no-any-return]
