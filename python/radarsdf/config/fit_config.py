# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The configuration of a fit: what is changed most often, the groups, and the presets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field

from radarsdf.config.groups import (
    MAX_THREADS,
    EncodingConfig,
    NetworksConfig,
    ReturnsConfig,
    TrainingConfig,
)
from radarsdf.config.presets import PAPER, QUICK
from radarsdf.lattice import WorldLattice
from radarsdf.settings import by_name, settings

# Edge of a block, leaf cells: a multiple of that of the cubes of visibility counts.
LATTICE_BLOCK_CELLS = 32
_MAX_SEED = 2**48  # generators have 64-bit seeds, and each fit uses MAX_THREADS + 1 of them
_Length = Annotated[float, Field(gt=0, le=1e6)]  # m: a cell of 1000 km is a mistake

_Group = ReturnsConfig | EncodingConfig | NetworksConfig | TrainingConfig


def _from_mapping(group: Any) -> Callable[[Any], Any]:
    """A validator that also accepts a dict of the group's settings."""
    name = group.__name__.removesuffix("Config").lower()
    return lambda value: group(**by_name(value, name)) if isinstance(value, Mapping) else value


@settings
class FitConfig:
    """The settings of a fit. The defaults are the best ones measured; :meth:`paper` is 3QFPI as published.

    The settings that are changed most often are at the top. The others are in groups; a group can be given as
    a dict.

    Raises
    ------
    ValueError
        At construction: for an unknown setting, or a value of the wrong type or out of range.

    Examples
    --------
    >>> config = FitConfig(leaf_size_m=0.3, training={"sdf_iterations": 200})
    >>> config.training.sdf_iterations, config.sigma_m
    (200, 0.15)
    """

    leaf_size_m: _Length = 0.2
    """Edge of a leaf cell, m (3QFPI: 0.2). It is the unit of all settings in `_cells`."""
    effort: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Multiplies the iterations that follow from the size of the data. 0.5 takes about half the time."""
    seed: Annotated[int, Field(ge=0, le=_MAX_SEED)] = 0
    """Seed of all random numbers of the fit. The same seed and data give the same bits, see :func:`radarsdf.fit`."""
    num_threads: Annotated[int, Field(ge=0, le=MAX_THREADS)] = 0
    """Threads of the fit. 0: as many as PyTorch uses."""
    max_memory_bytes: Annotated[int, Field(ge=1, lt=2**63)] | None = None
    """A fit or mesh that takes more is refused with a MemoryError, bytes. None: what the system has left."""
    train: bool = True
    """Whether a field is trained (stage 2). Otherwise the surface is the smoothed average of the rays (stage 1), intensities
    are in closed form, and of the groups only `returns` and `encoding.bridge_cells` count."""
    returns: Annotated[ReturnsConfig, BeforeValidator(_from_mapping(ReturnsConfig))] = ReturnsConfig()
    """Which returns are used, and how they are cleaned."""
    encoding: Annotated[EncodingConfig, BeforeValidator(_from_mapping(EncodingConfig))] = EncodingConfig()
    """How a position is encoded for the networks."""
    networks: Annotated[NetworksConfig, BeforeValidator(_from_mapping(NetworksConfig))] = NetworksConfig()
    """The two networks and their inputs."""
    training: Annotated[TrainingConfig, BeforeValidator(_from_mapping(TrainingConfig))] = TrainingConfig()
    """Losses, schedule and optimiser."""

    if TYPE_CHECKING:  # a group can be given as a dict, and is never read as one

        def __init__(
            self,
            *,
            leaf_size_m: float = ...,
            effort: float = ...,
            seed: int = ...,
            num_threads: int = ...,
            max_memory_bytes: int | None = ...,
            train: bool = ...,
            returns: ReturnsConfig | Mapping[str, Any] = ...,
            encoding: EncodingConfig | Mapping[str, Any] = ...,
            networks: NetworksConfig | Mapping[str, Any] = ...,
            training: TrainingConfig | Mapping[str, Any] = ...,
        ) -> None: ...

    def metres(self, cells: float) -> float:
        """A length in leaf cells, m."""
        return float(f"{cells * self.leaf_size_m:.12g}")  # 1.5 · 0.2 gives 0.3, not 0.30000000000000004

    @property
    def sigma_m(self) -> float:
        """`training.sigma_cells`, m."""
        return self.metres(self.training.sigma_cells)

    @property
    def lattice(self) -> WorldLattice:
        """Where cells lie in the world, from leaf cells to the coarsest."""
        return WorldLattice(self.leaf_size_m, max(LATTICE_BLOCK_CELLS, 2 ** (self.encoding.num_levels - 1)))

    @property
    def preparation(self) -> dict[str, Any]:
        """Keyword arguments of :func:`radarsdf.returns.rays.prepare`."""
        names = ("min_range_m", "max_range_m", "accumulate_scans")
        return {name: getattr(self.returns, name) for name in names} | {"lattice": self.lattice}

    @property
    def trains_intensity(self) -> bool:
        """Whether intensities, where there are any, train a network."""
        return self.train and self.networks.reflectance != "closed-form"

    @property
    def closes_intensity(self) -> bool:
        """Whether intensities, or what a network leaves of them, are in closed form."""
        return not self.train or self.networks.reflectance != "network"

    def moves_rows(self, with_intensity: bool) -> bool:
        """Whether an iteration changes only the features that its samples use: see `training.row_updates`."""
        # Normals are gradients of the features, which only autograd differentiates again, for all features at
        # once.
        through_normals = with_intensity and self.training.joint and self.networks.normals
        return self.training.row_updates and not through_normals

    @classmethod
    def quick(cls, **changes: Any) -> FitConfig:
        """Settings for stage 1 only: a surface that is averaged over the rays and smoothed, instead of trained.

        The fit takes a fraction of the time; the map is larger. Mesh it with voxels of the size of its leaf cells, since
        smaller ones show no more detail. Intensities are in closed form, and take a quarter to a half of the time
        without them. Free space is not kept: for that, change ``returns.passages``.
        `changes`: as for :meth:`override`.
        """
        return cls().override(**QUICK).override(**changes)

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """The settings of 3QFPI as published. `changes`: as for :meth:`override`.

        For a mesh as published, call ``mesh(min_confidence=0, max_uncertainty=math.inf, min_component_triangles=300)``.
        """
        return cls().override(**PAPER).override(**changes)

    def override(self, /, **changes: Any) -> FitConfig:
        """This configuration with some settings changed.

        Parameters
        ----------
        **changes
            Settings by name. For a group: a dict of the settings that change, or the whole group.

        Examples
        --------
        >>> FitConfig.paper().override(seed=1, training={"sdf_iterations": 200}).training.batch_size
        8192
        """
        merged: dict[str, Any] = {}
        for name, value in changes.items():
            group = getattr(self, name, None)
            if isinstance(group, _Group) and isinstance(value, Mapping):
                own = {field.name: getattr(group, field.name) for field in dataclasses.fields(group)}
                merged[name] = own | by_name(value, name)
            else:
                merged[name] = value
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return FitConfig(**(own | merged))

    def to_dict(self) -> dict[str, Any]:
        """The settings as nested dicts of plain values, for JSON and TOML."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FitConfig:
        """The inverse of :meth:`to_dict`. Missing settings have defaults; unknown ones raise a ValueError."""
        return cls().override(**by_name(values, "the settings"))


def settings_of_results(config: FitConfig) -> dict[str, Any]:
    """As :meth:`FitConfig.to_dict`, without what changes no result: two fits of the same scans that agree in these are one."""
    settings = config.to_dict()
    for name in ("num_threads", "max_memory_bytes"):
        del settings[name]
    return settings


def flat_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings, or changes of some, by names such as training.learning_rate."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= (
            {f"{name}.{own}": inner for own, inner in value.items()}
            if isinstance(value, dict)
            else {name: value}
        )
    return flat
