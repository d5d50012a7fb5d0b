# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The SDF network and the intensity network."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from radarsdf.config.fit_config import FitConfig
from radarsdf.field.encodings import SphericalHarmonics
from radarsdf.field.mlp import mlp
from radarsdf.field.widths import intensity_widths, sdf_widths


class Network(nn.Module):
    """Linear layers with ReLU between them. They have no memory until they are initialised or loaded."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
            layers.append(nn.Linear(inputs, outputs, device="meta", dtype=torch.float32))
            if i < len(widths) - 2:
                layers.append(nn.ReLU())
        self.layers = nn.Sequential(*layers)

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draws weights and biases like ``torch.nn.Linear``, but from `generator`."""
        for layer in self._linear():
            # Not to_empty(), which imports SymPy: a second.
            layer.weight, layer.bias = (
                nn.Parameter(torch.empty(p.shape, dtype=p.dtype, device="cpu"))
                for p in (layer.weight, layer.bias)
            )
            nn.init.kaiming_uniform_(layer.weight, a=math.sqrt(5), generator=generator)
            bound = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.bias, -bound, bound, generator=generator)

    def _linear(self) -> list[nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def _run(self, inputs: Sequence[Tensor]) -> Tensor:
        """Output of the layers for `inputs`, (N, width) each, side by side."""
        layers = [(layer.weight, layer.bias) for layer in self._linear()]
        return mlp([x for x in inputs if x.shape[1] > 0], layers)


class SDFNetwork(Network):
    """From the encoding of a point to signed distance / sigma, positive in free space, and a feature."""

    def __init__(self, config: FitConfig) -> None:
        super().__init__(sdf_widths(config))

    @torch.no_grad()
    def start_as_input(self, index: int) -> None:
        """Sets the weights so that the logit equals column `index` of the encoding.

        Two units of each hidden layer hold the positive and the negative part x of it: x = relu(x) -
        relu(-x).
        """
        first, *hidden, last = self._linear()
        for layer in (first, *hidden):
            layer.weight[:2] = 0
            layer.bias[:2] = 0
        first.weight[0, index], first.weight[1, index] = 1, -1
        for layer in hidden:
            layer.weight[0, 0] = layer.weight[1, 1] = 1
        last.weight[0] = 0
        last.bias[0] = 0
        last.weight[0, 0], last.weight[0, 1] = 1, -1

    def forward(self, encoding: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Logit (N,) and geometry feature (N, geometry_feature_dim) of encodings (N, width), side by side."""
        out = self._run(encoding)
        # The gradient of out[:, 0] is a matrix filled up with zeros. squeeze avoids it if there is only one
        # column.
        return out.squeeze(1) if out.shape[1] == 1 else out[:, 0], out[:, 1:]


class IntensityNetwork(Network):
    """Intensity of the return that a sensor gets from a point, scaled to about [0, 1].

    By the radar equation, P ∝ σ / r⁴, it depends on the range as well as on the direction. In dB it is linear
    in log r, so log r is the input.
    """

    def __init__(self, config: FitConfig) -> None:
        super().__init__(intensity_widths(config))
        networks = config.networks
        self.sdf_input = networks.sdf_input
        self.view_direction = networks.view_direction
        self.log_range = networks.log_range
        self.normals = networks.normals
        self.harmonics = SphericalHarmonics()

    def forward(
        self,
        encoding: Sequence[Tensor],
        logit: Tensor,
        geometry_feature: Tensor,
        normals: Tensor | None,
        directions: Tensor,
        ranges_m: Tensor,
    ) -> Tensor:
        """Scaled intensity (N,).

        Parameters
        ----------
        encoding, logit, geometry_feature : Tensor
            (N, width) each, (N,) and (N, geometry_feature_dim): inputs and outputs of the SDF network.
        normals : Tensor or None
            (N, 3) unit normals, towards free space. Needed if ``config.networks.normals``.
        directions, ranges_m : Tensor
            (N, 3) unit vectors from the sensor to the points, world axes, and the distances (N,), m.
        """
        inputs = [*encoding, geometry_feature]
        if self.sdf_input:
            inputs.append(logit[:, None])
        if self.normals:
            assert normals is not None
            inputs.append(normals)
        if self.view_direction:
            inputs.append(self.harmonics(directions))
        if self.log_range:
            inputs.append(torch.log10(ranges_m.clamp_min(1e-3) / 10.0)[:, None])
        return self._run(inputs).squeeze(1)
