# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every choice of a fit, with its unit, its range and its source.

"3QFP" and "3QFPI" name the papers (ICRA 2024; Neural Surface and Reflectance Modelling from 3D Radar Data) and their
published radar configuration. "Measured" stands for measurements on simulated and real scans; ``docs/levers.md`` has the
figures. A length that ends in ``_cells`` counts leaf cells, so that a scene in another unit needs one other number alone.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass
from typing_extensions import dataclass_transform

MAX_LEVELS = 12  # of the compiled core; a test holds the two equal
MAX_FREQUENCIES = 24  # likewise
MAX_THREADS = 1024
MAX_LAYERS = 32
MAX_SAMPLES = 2**24  # in a batch, or of a return
MAX_ITERATIONS = 2**31 - 1  # the core counts them in 32 bits
_MAX_BRIDGE_CELLS = 8  # more take time with their square, and join what does not belong together
_MAX_SEED = 2**48  # each thread draws from a generator of its own, numbered from the seed on
_MAX_WIDTH = 4096  # of a layer: far beyond what a map of a scene can use

_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]
_Count = Annotated[int, Field(ge=1, le=MAX_ITERATIONS)]
_Dropout = Annotated[float, Field(ge=0, le=0.95)]
_Widths = Annotated[
    tuple[Annotated[int, Field(ge=1, le=_MAX_WIDTH)], ...],
    Field(min_length=1, max_length=MAX_LAYERS, strict=False),  # TOML and JSON know lists, not tuples
]
_Class = TypeVar("_Class", bound=type)


@dataclass_transform(frozen_default=True, kw_only_default=True)
def _settings(cls: _Class) -> _Class:
    """A frozen dataclass whose values are checked at construction. A ValueError of one line names what is wrong."""
    rules = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
    checked = dataclass(frozen=True, kw_only=True, config=rules)(cls)
    construct: Callable[..., None] = checked.__init__
    group = cls.__name__.removesuffix("Config").lower()
    prefix = "" if group == "fit" else f"{group}."

    @functools.wraps(construct)
    def with_short_errors(self: Any, **values: Any) -> None:
        try:
            construct(self, **values)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            name = prefix + ".".join(part for part in first["loc"] if isinstance(part, str))
            if first["type"] == "value_error":  # of a check of our own, or of a group: it says all
                msg = first["msg"].removeprefix("Value error, ")
            elif first["type"] == "unexpected_keyword_argument":
                msg = f"unknown setting {name}"
            else:
                must = re.sub(r"^\w+ should", "must", first["msg"])
                msg = f"{name} {must}, not {first['input']!r:.50}"
            raise ValueError(msg) from None

    setattr(checked, "__init__", with_short_errors)  # noqa: B010 - mypy takes an assignment for a mistake
    return cast(_Class, checked)


@_settings
class ReturnsConfig:
    """Which returns are used, and how they are cleaned."""

    min_range_m: _NotNegative = 2.5
    """Returns nearer than this are dropped as clutter of the near field, m (3QFPI: 2.5; for the Oculii sensor 1)."""
    max_range_m: _Positive | None = None
    """Returns further than this are dropped, m. None: none are."""
    accumulate_scans: _Count = 1
    """Consecutive scans treated as one, seen from the position of the middle one. 3QFPI: 5, since it feeds scan by scan.
    Here a fit sees all returns at once, and each keeps the position that it was seen from."""
    drop_ghosts: bool = True
    """Whether the surface is learnt without returns behind a surface that their own rays passed through, as mirrors make
    them (3QFPI: no). Measured: 84 to 94 % of the surface that they cause is gone, with 0.7 % of the true returns. The
    intensity network learns from them all the same."""
    onto_planes: bool = True
    """Whether returns are moved onto the plane through the returns round them, where there is one (3QFPI: no). Measured:
    0.8 to 1.7 points of F-score on simulated scenes, -0.2 to 0.5 on real ones; up to 1 % more error of intensities."""

    @property
    def preparation(self) -> dict[str, Any]:
        """What :func:`radarsdf.returns.rays.prepare` is told for a fit."""
        names = ("min_range_m", "max_range_m", "accumulate_scans")
        return {name: getattr(self, name) for name in names}

    def __post_init__(self) -> None:
        if self.max_range_m is not None and self.max_range_m <= self.min_range_m:
            msg = f"returns.max_range_m must exceed min_range_m, {self.min_range_m}, not {self.max_range_m}"
            raise ValueError(msg)


@_settings
class EncodingConfig:
    """What the networks see of a position."""

    kind: Literal["tri-quadtree", "octree"] = "tri-quadtree"
    """Where the features live: on three planes (3QFP) or in space (SHINE-Mapping)."""
    num_levels: Annotated[int, Field(ge=1, le=MAX_LEVELS)] = 3
    """Levels of cells, each twice as large as the one before (3QFP)."""
    bridge_cells: Annotated[int, Field(ge=0, le=_MAX_BRIDGE_CELLS)] = 4
    """Empty cells in a row that become part of the map between two cells with returns (3QFP: 0). Four are as wide as a
    cell of the third level, over which its features interpolate. Measured: 0.8 to 3.8 points of F-score on every tenth
    scan of a scene, 0.5 and 0.8 on real scans, 0.0 to -0.2 on whole simulated scenes."""
    fourier_count: Annotated[int, Field(ge=0, le=MAX_FREQUENCIES)] = 10
    """Number of Fourier frequencies (3QFP: 16). The tenth's wavelength, 1.6 m, spans the coarsest cells, inside which the
    features take over. Finer ones, down to 2.5 cm, fit the noise."""
    fourier_half_width_cells: _Positive = 2048.0
    """Half of the longest Fourier wavelength, in leaf cells (3QFP: 409.6 m)."""


@_settings
class NetworksConfig:
    """The two networks and their inputs."""

    sdf_hidden: _Widths = (32, 32)
    """Widths of the hidden layers of the SDF network (3QFP)."""
    intensity_hidden: _Widths = (64, 64, 64)
    """Widths of the hidden layers of the intensity network (3QFPI: 64, 64). Measured: a third layer is worth 1 to 3 %."""
    geometry_feature_dim: Annotated[int, Field(ge=0, le=_MAX_WIDTH)] = 0
    """Numbers handed from the SDF network to the intensity network (3QFPI: 15; its own ablation shows no gain)."""
    normals: bool = False
    """Whether the intensity network sees the surface normal (3QFPI: yes; its own ablation shows no gain)."""
    sdf_input: bool = True
    """Whether the intensity network sees the signed distance (3QFPI)."""
    view_direction: bool = True
    """Whether the intensity network sees the viewing direction (3QFPI)."""
    log_range: bool = True
    """Whether the intensity network sees log10(range / 10 m), as the radar equation's r^-4 asks for (3QFPI: no). Measured:
    5 to 10 % less error, and no loss where a sensor compensates for the range."""
    feature_dropout: _Dropout = 0.85
    """Share of the cells' features hidden from the intensity network where its training sees each sample very often.
    Where it sees each sample n times: n / (n + 3) of this share, since few samples are easily memorised (3QFPI: 0).
    Measured, with the next: 0 to 2 % less error on long simulated scenes, 7 to 8 % on short ones, 1 to 3 % on real ones."""
    fourier_dropout: _Dropout = 0.25
    """The same for the Fourier encoding (3QFPI: 0)."""


@_settings
class SamplingConfig:
    """Where along the rays the training looks."""

    near_samples: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 6
    """Samples near the surface for every return (3QFPI)."""
    free_samples: Annotated[int, Field(ge=0, le=MAX_SAMPLES)] = 6
    """Samples in free space for every return (3QFPI)."""
    near_band_cells: _Positive = 1.5
    """Samples near the surface are uniform within this distance of the return, in leaf cells (3QFP: 0.3 m)."""
    free_from: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Samples in free space begin at this share of the range (3QFP)."""
    free_beyond_cells: _NotNegative = 4.0
    """Samples in free space end this far behind the return, in leaf cells (3QFP: 0.8 m)."""
    cross_range_noise_rad: _NotNegative = 0.005
    """Samples for the intensity are spread across the beam by this angle, one standard deviation, as the sensor's noise
    spreads returns, rad (3QFPI: 0)."""


@_settings
class TrainingConfig:
    """Losses, schedule and optimiser."""

    start: Literal["noise", "average"] = "noise"
    """What training starts from: noise (3QFP), or the average of the rays' truncated distances, which needs an octree."""
    truncation_cells: _Positive = 3.0
    """How far before and behind its return a ray counts in that average, and where it cuts distances, in leaf cells
    (VDBFusion: three voxels). Measured: 4 and 5 are as good on simulated scenes, 0.5 and 1.2 points worse on real ones."""
    sigma_cells: _Positive = 0.75
    """Scale of the sigmoid that turns distances into occupancy, in leaf cells (3QFP: 0.0275 m). Measured for radar: 0.1 to
    0.2 m."""
    sdf_loss_weight: _NotNegative = 1.0
    """Weight of the SDF's loss beside that of the intensity in a joint fit (3QFPI: equal). 0 is for ablations: all learns
    from intensities alone, and there is no surface."""
    intensity_in_free_space: bool = False
    """Whether samples in free space are labelled with the lowest intensity (3QFPI: yes). Measured: 10 to 25 % worse."""
    joint: bool = True
    """Whether the intensity network trains from the first iteration on, and its gradient reaches features and SDF network
    until these freeze (3QFPI). Otherwise it trains on the finished geometry. Measured: 1 to 3 % less error in equal time."""
    batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 4096
    """Samples in an iteration of the geometry (3QFP: 8192). Measured: half of it, twice as often, is better."""
    intensity_batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 2048
    """Samples in an iteration of the intensity network (3QFPI: 8192). Measured: more and smaller steps are better."""
    sdf_iterations: Annotated[int, Field(ge=0, le=MAX_ITERATIONS)] | None = None
    """Iterations of the geometry: SDF network and features, which are then frozen (3QFPI: 1000). None: from the size of the
    data and `effort`. 0: what the training starts from stays."""
    intensity_iterations: _Count | None = None
    """Iterations of the intensity network, those of a joint beginning included (3QFPI: 4000). None: likewise."""
    learning_rate: _Positive = 2e-2
    """Adam's for the geometry (3QFPI: 1e-3; 3QFP's radar configuration: 1e-2). Measured: twice that, where only touched
    features move, is worth 0.0 to 0.8 points of F-score on real scans, 0.1 either way on simulated ones."""
    intensity_learning_rate: _Positive = 7e-3
    """Adam's for the intensity network (3QFPI: 1e-3)."""
    cosine_schedule: bool = True
    """Whether the learning rates fall to zero along a cosine (3QFPI: constant)."""
    row_updates: bool = True
    """Whether an iteration moves only the features that its samples touch, instead of all by their fading momentum (3QFP:
    no). In a joint fit with `normals` all move in any case."""
    gradients: Literal["core", "autograd"] = "core"
    """What computes the losses and their gradients: one call of the compiled core, or PyTorch's autograd, the reference,
    two to three times as slow. With `normals` it is always autograd."""


_Group = ReturnsConfig | EncodingConfig | NetworksConfig | SamplingConfig | TrainingConfig


def _from_mapping(group: Any) -> Callable[[Any], Any]:
    """Lets a group be given as a dict of its settings."""
    return lambda value: group(**value) if isinstance(value, Mapping) else value


@_settings
class FitConfig:
    """How a map is fitted. The defaults are those measured to be best; :meth:`paper` is 3QFPI as published.

    At the top stand the settings that people change; the others are in groups. A group can be given as a dict.

    Raises
    ------
    ValueError
        At construction, for a value that is unknown, of another type or out of range.

    Examples
    --------
    >>> config = FitConfig(leaf_size_m=0.3, training={"sdf_iterations": 200})
    >>> config.training.sdf_iterations, config.near_band_m
    (200, 0.45)
    """

    leaf_size_m: _Positive = 0.2
    """Edge of the finest cells, m (3QFPI). All lengths in `_cells` follow from it."""
    effort: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """How long to train: multiplies the iterations that follow from the size of the data. 0.5 takes about half the time."""
    seed: Annotated[int, Field(ge=0, le=_MAX_SEED)] = 0
    """Seed of every random number of the fit: same seed, data and number of threads, same bits."""
    num_threads: Annotated[int, Field(ge=0, le=MAX_THREADS)] = 0
    """Threads. 0: as many as PyTorch uses."""
    max_memory_bytes: Annotated[int, Field(ge=1, lt=2**63)] | None = None
    """A fit or mesh that by its estimate takes more is refused by a MemoryError. None: what the system has."""
    returns: Annotated[ReturnsConfig, BeforeValidator(_from_mapping(ReturnsConfig))] = ReturnsConfig()
    """Which returns are used, and how they are cleaned."""
    encoding: Annotated[EncodingConfig, BeforeValidator(_from_mapping(EncodingConfig))] = EncodingConfig()
    """What the networks see of a position."""
    networks: Annotated[NetworksConfig, BeforeValidator(_from_mapping(NetworksConfig))] = NetworksConfig()
    """The two networks and their inputs."""
    sampling: Annotated[SamplingConfig, BeforeValidator(_from_mapping(SamplingConfig))] = SamplingConfig()
    """Where along the rays the training looks."""
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
            returns: ReturnsConfig | Mapping[str, Any] = ...,
            encoding: EncodingConfig | Mapping[str, Any] = ...,
            networks: NetworksConfig | Mapping[str, Any] = ...,
            sampling: SamplingConfig | Mapping[str, Any] = ...,
            training: TrainingConfig | Mapping[str, Any] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if self.training.start == "average":
            if self.encoding.kind != "octree" or min(self.networks.sdf_hidden) < 2:
                msg = "training.start 'average' needs encoding.kind 'octree' and networks.sdf_hidden of at least 2"
                raise ValueError(msg)
            # A vertex that no ray counts at would seem to lie on the surface.
            if self.training.truncation_cells < self.sampling.near_band_cells:
                msg = f"training.truncation_cells must be at least sampling.near_band_cells, {self.sampling.near_band_cells}"
                raise ValueError(msg)

    @property
    def near_band_m(self) -> float:
        """`sampling.near_band_cells`, m."""
        return self._metres(self.sampling.near_band_cells)

    @property
    def free_beyond_m(self) -> float:
        """`sampling.free_beyond_cells`, m."""
        return self._metres(self.sampling.free_beyond_cells)

    @property
    def truncation_m(self) -> float:
        """`training.truncation_cells`, m."""
        return self._metres(self.training.truncation_cells)

    @property
    def sigma_m(self) -> float:
        """`training.sigma_cells`, m."""
        return self._metres(self.training.sigma_cells)

    @property
    def fourier_half_width_m(self) -> float:
        """`encoding.fourier_half_width_cells`, m."""
        return self._metres(self.encoding.fourier_half_width_cells)

    def moves_rows(self, with_intensity: bool) -> bool:
        """Whether an iteration of the geometry moves only the features that its samples touch: see `training.row_updates`."""
        # Through normals the loss sees the features twice. Only autograd, on all features, can take that apart.
        twice = with_intensity and self.training.joint and self.networks.normals
        return self.training.row_updates and not twice

    def _metres(self, cells: float) -> float:
        return float(f"{cells * self.leaf_size_m:.12g}")  # 1.5 · 0.2 is 0.3, and not 0.30000000000000004

    @classmethod
    def quick(cls, **changes: Any) -> FitConfig:
        """An average of the rays instead of a trained surface: rougher and larger, in a fraction of the time.

        Mesh it with voxels of the size of its leaf cells: finer ones show no more. `changes` are those of
        :meth:`override`.
        """
        return cls(
            encoding=EncodingConfig(kind="octree", num_levels=1, fourier_count=0, bridge_cells=0),
            networks=NetworksConfig(sdf_hidden=(2,)),
            sampling=SamplingConfig(near_band_cells=2.0),
            training=TrainingConfig(start="average", sdf_iterations=0, joint=False),
        ).override(**changes)

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """3QFPI's configuration as published; `changes` are those of :meth:`override`.

        Its mesh leaves out other triangles than ours: ``mesh(min_support=0, min_component_triangles=300)``.
        """
        return cls(
            returns=ReturnsConfig(accumulate_scans=5, drop_ghosts=False, onto_planes=False),
            encoding=EncodingConfig(bridge_cells=0, fourier_count=16),
            networks=NetworksConfig(
                intensity_hidden=(64, 64),
                geometry_feature_dim=15,
                normals=True,
                log_range=False,
                feature_dropout=0.0,
                fourier_dropout=0.0,
            ),
            sampling=SamplingConfig(cross_range_noise_rad=0.0),
            training=TrainingConfig(
                sigma_cells=0.1375,  # 0.55 · 0.05 m
                intensity_in_free_space=True,
                batch_size=8192,
                intensity_batch_size=8192,
                sdf_iterations=1000,
                intensity_iterations=4000,
                learning_rate=1e-3,
                intensity_learning_rate=1e-3,
                cosine_schedule=False,
                row_updates=False,
            ),
        ).override(**changes)

    def override(self, **changes: Any) -> FitConfig:
        """This configuration with some settings changed.

        Parameters
        ----------
        **changes
            Settings of the top; for a group a dict of those of its settings that change.

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
                merged[name] = type(group)(**(own | dict(value)))
            else:
                merged[name] = value
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return FitConfig(**(own | merged))

    def to_dict(self) -> dict[str, Any]:
        """Plain values in nested dicts, for JSON and TOML."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FitConfig:
        """The inverse of :meth:`to_dict`. What is missing has its default; an unknown name is a ValueError."""
        return cls().override(**values)
