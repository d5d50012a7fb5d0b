"""The configuration of a fit: the settings changed most often, the groups, the presets, and their TOML file."""

import dataclasses
import json
import sys
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field

from radarsdf.checks import AnyPath, restating
from radarsdf.config.groups import MAX_THREADS, EncodingConfig, NetworksConfig, ReturnsConfig, TrainingConfig
from radarsdf.lattice import WorldLattice
from radarsdf.settings import by_name, settings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# Edge of a block, leaf cells: a multiple of the edges of a visibility cube and of the coarsest cells.
LATTICE_BLOCK_CELLS = 32
_MAX_SEED = 2**48  # generators have 64-bit seeds, and each fit uses MAX_THREADS + 1 of them
_Length = Annotated[float, Field(gt=0, le=1e6)]  # m: a cell of 1000 km is a mistake

QUICK: dict[str, Any] = {"train": False, "returns": {"free_space": False}}
"""What :meth:`FitConfig.quick` changes: no training, and nothing kept for grids and comparisons."""

PAPER: dict[str, Any] = {
    "returns": {
        "accumulate_scans": 5,
        "drop_moving": False,
        "drop_ghosts": False,
        "onto_planes": False,
        "free_space": False,
    },
    "encoding": {"bridge_cells": 0, "fourier_count": 16},
    "networks": {
        "intensity_hidden": (64, 64),
        "geometry_feature_dim": 15,
        "normals": True,
        "log_range": False,
        "dropout": False,
        "reflectance": "network",
    },
    "training": {
        "sigma_cells": 0.1375,  # 0.55 · 0.05 m
        "intensity_in_free_space": True,
        "cross_range_noise_rad": 0.0,
        "batch_size": 8192,
        "intensity_batch_size": 8192,
        "sdf_iterations": 1000,
        "intensity_iterations": 4000,
        "optimiser": "adam",
        "learning_rate": 1e-3,
        "intensity_learning_rate": 1e-3,
    },
}
"""What :meth:`FitConfig.paper` changes: 3QFP (ICRA 2024) and 3QFPI as published."""


def _from_mapping(group: Any) -> Callable[[Any], Any]:
    """A validator that also accepts a dict of the group's settings."""
    name = group.__name__.removesuffix("Config").lower()
    return lambda value: group(**by_name(value, name)) if isinstance(value, Mapping) else value


@settings
class FitConfig:
    """The settings of a fit. The defaults are the best ones measured; :meth:`paper` is 3QFPI as published.

    The settings that are changed most often are at the top. The others are in groups; a group can be given as a dict.
    Construction raises a ValueError for an unknown setting, or a value of the wrong type or out of range.

    Examples
    --------
    >>> config = FitConfig(leaf_size_m=0.3, training={"sdf_iterations": 200})
    >>> config.training.sdf_iterations, config.sigma_m
    (200, 0.15)
    """

    leaf_size_m: _Length = 0.2
    """Edge of a leaf cell, m (3QFPI: 0.2). It is the unit of all settings in `_cells`."""
    effort: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Factor on the number of iterations, which follows from the size of the data. 0.5 takes about half the time."""
    seed: Annotated[int, Field(ge=0, le=_MAX_SEED)] = 0
    """Seed of all random numbers of the fit. The same seed and data give the same bits, see :func:`radarsdf.fit`."""
    num_threads: Annotated[int, Field(ge=0, le=MAX_THREADS)] = 0
    """Number of threads. 0: as many as PyTorch uses."""
    max_memory_bytes: Annotated[int, Field(ge=1, lt=2**63)] | None = None
    """Memory limit, bytes; a fit or mesh that needs more raises a MemoryError. None: what the system has available."""
    train: bool = True
    """Whether to train a field. If not, the surface is the smoothed average of the rays, intensities come from the
    closed-form model, and of the groups only `returns` (except `onto_planes`) and `encoding.bridge_cells` apply."""
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
        """Convert a length in leaf cells to m."""
        return float(f"{cells * self.leaf_size_m:.12g}")  # 1.5 · 0.2 gives 0.3, not 0.30000000000000004

    @property
    def sigma_m(self) -> float:
        """`training.sigma_cells` in m."""
        return self.metres(self.training.sigma_cells)

    @property
    def lattice(self) -> WorldLattice:
        """The lattice of all cells, from leaf cells to the coarsest."""
        return WorldLattice(self.leaf_size_m, LATTICE_BLOCK_CELLS)

    @property
    def preparation(self) -> dict[str, Any]:
        """Keyword arguments of :func:`radarsdf.returns.rays.prepare`."""
        names = ("min_range_m", "max_range_m", "accumulate_scans")
        return {name: getattr(self.returns, name) for name in names} | {"lattice": self.lattice}

    @property
    def trains_intensity(self) -> bool:
        """Whether a network is trained on intensities, if there are any."""
        return self.train and self.networks.reflectance != "closed-form"

    @property
    def closes_intensity(self) -> bool:
        """Whether intensities, or the residuals of a network, are fitted in closed form."""
        return not self.train or self.networks.reflectance != "network"

    def moves_rows(self, with_intensity: bool) -> bool:
        """Whether an iteration updates only the features that its samples use."""
        # Normals are gradients of the features: only autograd differentiates them again, and it updates all at once.
        through_normals = with_intensity and self.networks.normals
        return self.training.optimiser == "soap" and not through_normals

    @classmethod
    def quick(cls, **changes: Any) -> "FitConfig":
        """Return the settings without training: distances averaged over the rays and smoothed, not trained.

        The fit takes a fraction of the time; the map's file is larger. Intensities are fitted in closed form. Mesh the map with
        voxels of the size of a leaf cell: smaller ones show no more detail.

        `changes` are further settings, as for :meth:`override`, which also lists the errors. ``returns={"free_space": True}``
        keeps what :func:`radarsdf.grid` and :func:`radarsdf.compare` need.
        """
        return cls().override(**QUICK).override(**changes)

    @classmethod
    def paper(cls, **changes: Any) -> "FitConfig":
        """Return the settings of 3QFPI as published, for comparisons.

        For a mesh as published, call ``mesh(min_confidence=0, max_uncertainty=math.inf, min_component_triangles=300)``.
        `changes` are further settings, as for :meth:`override`, which also lists the errors.
        """
        return cls().override(**PAPER).override(**changes)

    def override(self, /, **changes: Any) -> "FitConfig":
        """Return a copy with some settings changed, by name; for a group, `changes` hold a dict of its settings, or all of it.

        Raises a ValueError for an unknown setting, or a value of the wrong type or out of range.

        Examples
        --------
        >>> FitConfig.paper().override(seed=1, training={"sdf_iterations": 200}).training.batch_size
        8192
        """
        merged: dict[str, Any] = dict(vars(self))
        for name, value in changes.items():
            group = merged.get(name)
            inside = dataclasses.is_dataclass(group) and isinstance(value, Mapping)
            merged[name] = vars(group) | by_name(value, name) if inside else value
        return FitConfig(**merged)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain values by name, with a dict for each group, as JSON and TOML store them."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "FitConfig":
        """Build a configuration from nested dicts, such as those of :meth:`to_dict` or a TOML file.

        Missing settings keep their defaults. Raises the errors of :meth:`override`, and a ValueError for anything but a mapping.
        """
        return cls().override(**by_name(values, "the settings"))


def settings_of_results(config: FitConfig) -> dict[str, Any]:
    """Return :meth:`FitConfig.to_dict` without the settings that affect no result: two fits that agree in these are equal."""
    without = ("num_threads", "max_memory_bytes")
    return {name: value for name, value in config.to_dict().items() if name not in without}


def flat_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested settings to names such as training.learning_rate."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        group = value if isinstance(value, dict) else {"": value}
        flat |= {f"{name}.{own}".rstrip("."): inner for own, inner in group.items()}
    return flat


_WIDTH = 100  # columns of a comment


def read_toml(path: AnyPath) -> dict[str, Any]:
    """Read settings from a TOML file, as :meth:`FitConfig.override` takes them. A ValueError: the file is not TOML."""
    with restating(f"{path} is not a TOML file", ValueError, RecursionError):  # of lists in lists without end
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))


def to_toml(config: FitConfig) -> str:
    """Format all settings as TOML, each below a comment that explains it; None becomes a comment, because TOML has no null."""
    return "\n".join(_toml_lines(config)) + "\n"


def _toml_lines(group: Any) -> list[str]:
    lines, tables = list[str](), list[str]()
    for name, field in group.__pydantic_fields__.items():
        value, text = getattr(group, name), " ".join((field.description or "").split())
        comment = textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        if dataclasses.is_dataclass(value):
            tables += ["", f"[{name}]", *comment, "", *_toml_lines(value)]
        else:  # TOML writes numbers, strings, booleans and lists as JSON does
            lines += [*comment, f"# {name} =" if value is None else f"{name} = {json.dumps(value)}"]
    return lines + tables
