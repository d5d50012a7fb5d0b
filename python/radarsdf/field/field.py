"""Fields of signed distance and intensity at points of the local frame: averaged on a grid, or trained, with networks."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional

from radarsdf.arrays import Floats32, Keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import FEATURE_DIM, NUM_SPHERICAL_HARMONICS, Encoding, VertexTable
from radarsdf.field import kernels
from radarsdf.returns.reflectance import Reflectance

NUM_LEVELS = 3  # levels of cells (3QFP)
_FEATURE_STD = 0.05  # initial standard deviation of the features (3QFP)
SDF_HIDDEN = (32, 32)  # widths of the hidden layers of the SDF network (3QFP)
# Half of the longest Fourier wavelength, leaf cells (3QFP: 409.6 m).
FOURIER_HALF_WIDTH_CELLS = 2048.0


class Field(nn.Module, ABC):
    """Signed distance field on leaf cells. :class:`GridField` and :class:`NeuralField` implement it."""

    table: VertexTable  # the leaf cells, and the rows of the values stored at their corners

    def __init__(self) -> None:
        super().__init__()
        self.reflectance: Reflectance | None = None  # closed-form intensities, or the residuals of a network

    @abstractmethod
    def sdf(self, points: Tensor) -> Tensor:
        """Return differentiable signed distances (N,), m, positive in free space, at points (N, 3), local frame, m."""

    def plane(self, points: Tensor) -> Tensor:
        """Return :meth:`sdf` and its gradient, pointing to free space, (N, 4), without a graph."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            sdf = self.sdf(points)
            (gradient,) = torch.autograd.grad(sdf.sum(), points)
        return torch.cat([sdf.detach()[:, None], gradient], 1)

    def intensity(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """Return intensities (N,), scaled to about [0, 1], of returns from points (N, 3), local frame, m.

        `directions` (N, 3): unit vectors from the sensor; `ranges_m` (N,): distances from it.
        """
        # The closed form is unbounded; intensities beyond the range of the returns were never measured.
        return self._closed_form(points, directions, ranges_m).clamp(0, 1)

    def occupied(self, points: Tensor) -> Tensor:
        """Return a mask (N,) of the points (N, 3), local frame, m, in occupied leaf cells."""
        return kernels.locate(points, self.table)[:, 0] >= 0

    def corner_distances_m(self) -> Floats32 | None:
        """Return the distances of which :meth:`sdf` is the trilinear interpolation, by row of the table; None if it is not."""
        return None

    @property
    def smooth_in_cells(self) -> bool:
        """Whether the signs at the corners of a leaf cell reveal any zero crossing inside."""
        return True

    def _closed_form(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        if self.reflectance is None:
            return torch.zeros_like(ranges_m)
        return torch.from_numpy(self.reflectance.at(points.numpy(), directions.numpy(), ranges_m.numpy(), 1))


class GridField(Field):
    """Signed distances `distances_m` (V,) at the corners of leaf cells, interpolated trilinearly. 0 outside the cells.

    `leaf_keys` (C,): Morton keys of the occupied leaf cells, ascending. The distances are not initialised.
    """

    def __init__(self, leaf_keys: Keys, leaf_size_m: float, num_threads: int = 0) -> None:
        super().__init__()
        self.table = VertexTable(leaf_keys, leaf_size_m, 1, Encoding.OCTREE, num_threads)
        self.distances_m = nn.Parameter(torch.empty(self.table.num_rows, dtype=torch.float32, device="cpu"))

    def sdf(self, points: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return self.plane(points)[:, 0].contiguous()
        cells = kernels.locate(points, self.table)[:, 0]
        inside = cells >= 0
        corners = self._corners_of_cells.index_select(0, cells.clamp(min=0)).view(-1)
        values = self.distances_m.index_select(0, corners).view(-1, 2, 2, 2)
        # The core's rounding, or a point could be in another cell.
        place = points * (1 / self.table.leaf_size_m)
        x, y, z = (place - place.detach().floor()).unbind(1)
        values = torch.lerp(values[:, 0], values[:, 1], x[:, None, None])
        values = torch.lerp(values[:, 0], values[:, 1], y[:, None])
        return torch.where(inside, torch.lerp(values[:, 0], values[:, 1], z), 0.0)

    def plane(self, points: Tensor) -> Tensor:
        values, x = kernels.view(self.distances_m), kernels.view(points)
        return torch.from_numpy(self.table.trilinear(values, x, torch.get_num_threads()))

    def corner_distances_m(self) -> Floats32:
        return kernels.view(self.distances_m)

    @cached_property
    def _corners_of_cells(self) -> Tensor:
        """Rows (C, 8) of `distances_m`, int32, in C order of the corners."""
        return torch.from_numpy(self.table.leaf_vertices()[1])


@dataclass(frozen=True)
class Geometry:
    """Inputs and outputs of the SDF network at N points."""

    encoding: tuple[Tensor, ...]  # (N, width) each: features of the cells, and the Fourier encoding if used
    logit: Tensor  # (N,) signed distance / sigma, positive in free space
    feature: Tensor  # (N, geometry_feature_dim), an input of the intensity network
    normals: Tensor | None  # (N, 3) unit vectors towards free space, if the intensity network uses them

    def first(self, count: int, factors: Sequence[Tensor]) -> "Geometry":
        """Return the first `count` points, with each part of the encoding multiplied by its dropout `factors`, if any."""
        normals = None if self.normals is None else self.normals[:count]
        encoding = tuple(part[:count] for part in self.encoding)
        if factors:
            encoding = tuple(part * kept for part, kept in zip(encoding, factors, strict=True))
        return Geometry(encoding, self.logit[:count], self.feature[:count], normals)


class VertexFeatures(nn.Module):
    """Learnable features, 8 floats at each vertex of the occupied cells, interpolated inside the cells.

    They lie on quadtrees in the planes xy, xz and yz, summed over the planes (3QFP, ICRA 2024), or at the corners of an
    octree's cells (SHINE-Mapping, ICRA 2023). Cells double in size from level to level.
    """

    def __init__(
        self, leaf_keys: Keys, leaf_size_m: float, num_levels: int, encoding: Encoding, num_threads: int = 0
    ) -> None:
        super().__init__()
        self._summed = encoding == Encoding.OCTREE
        self.table = VertexTable(leaf_keys, leaf_size_m, num_levels, encoding, num_threads)
        self.features = nn.Parameter(kernels.large_zeros(self.table.num_rows, FEATURE_DIM))
        self.interpolated_dim = FEATURE_DIM * num_levels

    def forward(self, points: Tensor) -> Tensor:
        """Encode points (N, 3), local frame, m: levels concatenated, (N, 8 · num_levels), or summed for an octree, (N, 8)."""
        found = kernels.interpolate(self.features, points, self.table)
        return found.view(len(points), self.table.num_levels, FEATURE_DIM).sum(1) if self._summed else found


class NeuralField(Field):
    """Features of cells and a Fourier encoding, decoded to signed distance and intensity by two networks.

    `leaf_keys` (C,): Morton keys of the occupied leaf cells, ascending. `with_intensity`: whether to add the second network.
    """

    def __init__(
        self, leaf_keys: Keys, config: FitConfig, *, with_intensity: bool, num_threads: int = 0
    ) -> None:
        super().__init__()
        encoding = Encoding.TRI_QUADTREE if config.encoding.kind == "tri-quadtree" else Encoding.OCTREE
        self.sigma_m = config.sigma_m
        self.cells = VertexFeatures(leaf_keys, config.leaf_size_m, NUM_LEVELS, encoding, num_threads)
        self.table = self.cells.table
        self.half_width_m = config.metres(FOURIER_HALF_WIDTH_CELLS)
        self.num_frequencies = config.encoding.fourier_count
        self.sdf_network = SDFNetwork(sdf_widths(config))
        self.intensity_network = IntensityNetwork(config) if with_intensity else None

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights of the networks, then the features (3QFP)."""
        self.sdf_network.initialise(generator)
        if self.intensity_network is not None:
            self.intensity_network.initialise(generator)
        nn.init.normal_(self.cells.features, std=_FEATURE_STD, generator=generator)

    @property
    def smooth_in_cells(self) -> bool:
        # No wavelength of the encoding is shorter than two leaf cells.
        shortest_m = 2 * self.half_width_m / 2 ** (self.num_frequencies - 1)
        return self.num_frequencies == 0 or shortest_m >= 2 * self.table.leaf_size_m

    def encode(self, points: Tensor) -> tuple[Tensor, ...]:
        """Return the inputs of the SDF network, (N, width) each, at points (N, 3), local frame, m."""
        cells = self.cells(points)
        if self.num_frequencies == 0:
            return (cells,)
        return cells, kernels.fourier(points, self.half_width_m, 0, self.num_frequencies)

    def logit(self, points: Tensor) -> Tensor:
        """Return signed distances / sigma (N,), positive in free space, at points (N, 3), local frame, m."""
        return self.sdf_network(self.encode(points))[0]

    def sdf(self, points: Tensor) -> Tensor:
        return self.logit(points) * self.sigma_m

    def geometry(self, points: Tensor, *, frozen: bool = True) -> Geometry:
        """Return the inputs of the intensity network at points (N, 3), local, m. `frozen`: detach features and SDF network."""
        wants_normals = self.intensity_network is not None and self.intensity_network.sees.normals
        # A normal is the gradient of the logit: it needs an autograd graph even if the field is frozen.
        with torch.set_grad_enabled((torch.is_grad_enabled() and not frozen) or wants_normals):
            if wants_normals:
                points = points.detach().requires_grad_()
            encoding = self.encode(points)
            logit, feature = self.sdf_network(encoding)
            normals = None
            if wants_normals:
                (gradient,) = torch.autograd.grad(logit.sum(), points, create_graph=not frozen)
                normals = functional.normalize(gradient, dim=1)
        if frozen:
            encoding = tuple(part.detach() for part in encoding)
            logit, feature = logit.detach(), feature.detach()
        return Geometry(encoding, logit, feature, normals)

    def intensity(self, points: Tensor, directions: Tensor, ranges_m: Tensor) -> Tensor:
        unit = self._closed_form(points, directions, ranges_m)
        closed = self.reflectance
        share = 1.0 if closed is None else closed.network_share
        if share > 0:
            assert self.intensity_network is not None
            unit += share * self.intensity_network(self.geometry(points), directions, ranges_m)
        return unit if closed is None else unit.clamp(0, 1)


class Network(nn.Module):
    """Linear layers with ReLU between them, without memory until they are initialised or loaded."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        layers = list[nn.Module]()
        for inputs, outputs in itertools.pairwise(widths):
            layers += [nn.Linear(inputs, outputs, device="meta", dtype=torch.float32), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draw weights and biases like ``torch.nn.Linear``, but from `generator`."""
        for layer in self._linear():
            # Not to_empty(): it imports SymPy, which takes a second.
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
        """Apply the layers to the concatenated `inputs`, (N, width) each."""
        layers = [(layer.weight, layer.bias) for layer in self._linear()]
        return kernels.mlp([x for x in inputs if x.shape[1] > 0], layers)


class SDFNetwork(Network):
    """Decoder of the encoding of a point to signed distance / sigma, positive in free space, and a feature."""

    def forward(self, encoding: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return logits (N,) and geometry features (N, geometry_feature_dim) of concatenated encodings (N, width)."""
        out = self._run(encoding)
        # The gradient of out[:, 0] is a matrix padded with zeros, which squeeze avoids for a single column.
        return out.squeeze(1) if out.shape[1] == 1 else out[:, 0], out[:, 1:]


class IntensityNetwork(Network):
    """Decoder of the intensity that a sensor measures at a point, scaled to about [0, 1].

    By the radar equation, P ∝ σ / r⁴, it depends on range and direction. In dB it is linear in the input log r.
    """

    def __init__(self, config: FitConfig) -> None:
        super().__init__(intensity_widths(config))
        self.sees = config.networks

    def forward(self, geometry: Geometry, directions: Tensor, ranges_m: Tensor) -> Tensor:
        """Return scaled intensities (N,) along unit vectors (N, 3) from ranges (N,), m."""
        inputs = [*geometry.encoding, geometry.feature, geometry.logit[:, None]]
        if self.sees.normals:
            assert geometry.normals is not None
            inputs.append(geometry.normals)
        if self.sees.view_direction:
            inputs.append(kernels.spherical_harmonics(directions))
        if self.sees.log_range:
            inputs.append(torch.log10(ranges_m.clamp_min(1e-3) / 10.0)[:, None])
        return self._run(inputs).squeeze(1)


def cells_width(config: FitConfig) -> int:
    """Return the width of the encoding by cells: a tri-quadtree concatenates levels, an octree sums them."""
    return FEATURE_DIM * (NUM_LEVELS if config.encoding.kind == "tri-quadtree" else 1)


def fourier_width(config: FitConfig) -> int:
    """Return the width of the Fourier encoding: sine and cosine of three coordinates for each frequency."""
    return 6 * config.encoding.fourier_count


def sdf_widths(config: FitConfig) -> tuple[int, ...]:
    """Return the widths of the input, the hidden layers and the output of the SDF network."""
    inputs = cells_width(config) + fourier_width(config)
    return (inputs, *SDF_HIDDEN, 1 + config.networks.geometry_feature_dim)


def intensity_widths(config: FitConfig) -> tuple[int, ...]:
    """Return the widths of the input, the hidden layers and the output of the intensity network."""
    networks = config.networks
    inputs = (
        cells_width(config)
        + fourier_width(config)
        + networks.geometry_feature_dim
        + 1  # the logit
        + 3 * networks.normals
        + NUM_SPHERICAL_HARMONICS * networks.view_direction
        + networks.log_range
    )
    return (inputs, *networks.intensity_hidden, 1)


def weights_of(widths: tuple[int, ...]) -> int:
    """Return the number of weights without biases, which is the number of multiplications for a point."""
    return sum(inputs * outputs for inputs, outputs in itertools.pairwise(widths))
