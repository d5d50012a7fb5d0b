# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The settings of a fit, with unit, range and source.

"3QFP" (ICRA 2024) and "3QFPI" (Neural Surface and Reflectance Modelling from 3D Radar Data) are the papers
and their published settings for radar. "Measured" means measured on simulated and real scans;
``bench/history/surface.md`` has the figures. Lengths that end in ``_cells`` are in leaf cells: for another scale of
scene, only `leaf_size_m` has to change.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from radarsdf.lattice import WorldLattice
from radarsdf.settings import by_name, settings

MAX_LEVELS = 12  # levels of cells that the compiled core allows; a test compares the two numbers
MAX_FREQUENCIES = 24  # Fourier frequencies that the compiled core allows; likewise
MAX_THREADS = 1024
MAX_LAYERS = 32  # hidden layers of a network
MAX_SAMPLES = 2**24  # samples in a batch, and samples for a return
MAX_ITERATIONS = 2**31 - 1  # the core counts iterations in 32 bits
_MAX_BRIDGE_CELLS = 8  # the time grows with the square, and longer bridges join separate surfaces
_MAX_SEED = 2**48  # generators have 64-bit seeds, and each fit uses MAX_THREADS + 1 of them
BLOCK_CELLS = 32  # edge of a block, leaf cells: a multiple of that of the cubes in which looks are counted
_MAX_WIDTH = 4096  # units of a layer: far more than a map of a scene can use

_MAX_NOISE_M, _MAX_NOISE_RAD = 100, 1
_NoiseM = Annotated[float, Field(gt=0, le=_MAX_NOISE_M)]
_NoiseRad = Annotated[float, Field(gt=0, le=_MAX_NOISE_RAD)]
_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]
_Length = Annotated[float, Field(gt=0, le=1e6)]  # m: a cell of 1000 km is a mistake
_Count = Annotated[int, Field(ge=1, le=MAX_ITERATIONS)]
_Dropout = Annotated[float, Field(ge=0, le=0.95)]
_Widths = Annotated[
    tuple[Annotated[int, Field(ge=1, le=_MAX_WIDTH)], ...],
    Field(min_length=1, max_length=MAX_LAYERS, strict=False),  # TOML and JSON have lists, not tuples
]


@settings
class ReturnsConfig:
    """Which returns are used, and how they are cleaned."""

    min_range_m: _NotNegative = 2.5
    """Returns nearer than this are dropped as near-field clutter, m (3QFPI: 2.5; Oculii: 1)."""
    max_range_m: _Positive | None = None
    """Returns farther than this are dropped, m. None: no limit."""
    accumulate_scans: _Count = 1
    """So many consecutive scans are treated as seen from the position of the middle one (3QFPI: 5, since it
    trains scan by scan). Here 1 is enough: a fit trains on all scans at once."""
    drop_movers: bool = True
    """Whether returns are left out whose Doppler, where it is given, disagrees with a world that stands still (3QFPI:
    no). Measured: 0.1 to 8.6 points of F-score on five real drives, 5.9 on a simulated street with cars, 0.0 on one
    without."""
    drop_ghosts: bool = True
    """Whether the sdf stage leaves out ghosts: returns behind a surface that their rays crossed, as mirrors
    cause them (3QFPI: no). Measured: 84 to 94 % of the surface that ghosts cause is gone, and 0.7 % of the
    true returns. The intensity stage still uses ghosts."""
    range_noise_m: _NoiseM | None = None
    """Standard deviation of a return along the beam, m. None: estimated from the returns; see
    :func:`radarsdf.returns.noise.sensor_noise`."""
    azimuth_noise_rad: _NoiseRad | None = None
    """The same in azimuth, rad. None: likewise."""
    elevation_noise_rad: _NoiseRad | None = None
    """The same in elevation, rad. None: likewise."""
    pose_sigma_m: Annotated[float, Field(ge=0, le=_MAX_NOISE_M)] = 0.0
    """Standard deviation of the position of a scan, m. It only makes the map's uncertainty larger: all returns
    of a scan share the error, so that only more scans make it smaller."""
    pose_sigma_rad: Annotated[float, Field(ge=0, le=_MAX_NOISE_RAD)] = 0.0
    """The same of the orientation of a scan, rad. At a return it counts times the range."""
    onto_planes: bool = True
    """Whether each return is moved towards the surfel of its cell, a plane through the returns there, if there
    is one (3QFPI: no). Measured: 0.8 to 1.7 points of F-score on simulated scenes, -0.9 to 0.5 on real ones;
    up to 1 % more error of intensities."""

    def __post_init__(self) -> None:
        if self.max_range_m is not None and self.max_range_m <= self.min_range_m:
            msg = f"returns.max_range_m must exceed min_range_m, {self.min_range_m}, not {self.max_range_m}"
            raise ValueError(msg)


@settings
class EncodingConfig:
    """How a position is encoded for the networks."""

    kind: Literal["tri-quadtree", "octree"] = "tri-quadtree"
    """Where the features are: on quadtrees in three planes (3QFP) or on an octree (SHINE-Mapping)."""
    num_levels: Annotated[int, Field(ge=1, le=MAX_LEVELS)] = 3
    """Levels of cells. The cells of each level are twice as large as those of the level before (3QFP: 3)."""
    bridge_cells: Annotated[int, Field(ge=0, le=_MAX_BRIDGE_CELLS)] = 4
    """A gap of at most so many empty leaf cells between two cells with returns becomes part of the map (3QFP:
    0). Four are as wide as a cell of the third level, so its features interpolate across the gap. Measured:
    0.8 to 3.8 points of F-score on every tenth scan of a scene, 0.5 and 0.8 on real scans, 0.0 to -0.2 on
    whole simulated scenes."""
    fourier_count: Annotated[int, Field(ge=0, le=MAX_FREQUENCIES)] = 10
    """Number of Fourier frequencies (3QFP: 16). The tenth has a wavelength of 8 leaf cells, twice the edge of
    the coarsest cells; details inside these are left to the features. Shorter wavelengths fit the noise."""
    fourier_half_width_cells: _Positive = 2048.0
    """Half of the longest Fourier wavelength, in leaf cells (3QFP: 409.6 m)."""


@settings
class NetworksConfig:
    """The two networks and their inputs."""

    sdf_hidden: _Widths = (32, 32)
    """Widths of the hidden layers of the SDF network (3QFP)."""
    intensity_hidden: _Widths = (64, 64, 64)
    """Widths of the hidden layers of the intensity network (3QFPI: 64, 64). Measured: the third gives 1 to 3
    % less error."""
    geometry_feature_dim: Annotated[int, Field(ge=0, le=_MAX_WIDTH)] = 0
    """Numbers that the SDF network passes to the intensity network (3QFPI: 15; its ablation shows no gain)."""
    reflectance: Literal["network", "closed-form", "both"] = "both"
    """What answers for intensities: the intensity network (3QFPI); regressions on range, elevation and
    incidence, and means in cells of what these leave, in closed form; or the mean of the network, and of half of
    it with what that leaves in closed form. Measured: both have 2 to 3 % less error than the network on real
    drives, and 7 % less to 0.4 % more on simulated scenes; the file is a fifth to two fifths larger. The closed
    form alone takes 0.03 to 0.1 s instead of seconds. It has 0 to 2 % less error than the network on real drives,
    and mostly 1 to 10 % more on simulated scenes."""
    normals: bool = False
    """Whether the intensity network sees the surface normal (3QFPI: yes; its own ablation shows no gain)."""
    sdf_input: bool = True
    """Whether the intensity network sees the signed distance (3QFPI)."""
    view_direction: bool = True
    """Whether the intensity network sees the viewing direction (3QFPI)."""
    log_range: bool = True
    """Whether the intensity network sees log10(range / 10 m), since the received power falls with r^-4
    (3QFPI: no). Measured: 5 to 10 % less error, and no loss for a sensor that compensates for the range."""
    feature_dropout: _Dropout = 0.85
    """Dropout of the cells' features before the intensity network (3QFPI: 0). If the training uses each
    sample n times, this is multiplied by n / (n + 2.5): the more often a sample is used, the more easily the
    network memorises it. Measured together with `fourier_dropout`: 0 to 2 % less error on long simulated
    scenes, 7 to 8 % on short ones, 1 to 3 % on real ones."""
    fourier_dropout: _Dropout = 0.25
    """The same for the Fourier encoding (3QFPI: 0)."""


@settings
class SamplingConfig:
    """Where on the rays the training samples are."""

    near_samples: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 6
    """Samples near the surface for each return in one pass (3QFPI: 6)."""
    free_samples: Annotated[int, Field(ge=0, le=MAX_SAMPLES)] = 6
    """Samples in free space for each return in one pass (3QFPI: 6)."""
    near_band_cells: _Positive = 1.5
    """Samples near the surface are uniform within this distance of the return, in leaf cells (3QFP: 0.3
    m)."""
    free_from: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Samples in free space begin at this share of the range (3QFP: 0.3)."""
    free_beyond_cells: _NotNegative = 4.0
    """Samples in free space end this far behind the return, in leaf cells (3QFP: 0.8 m)."""
    cross_range_noise_rad: _NotNegative = 0.005
    """Noise across the beam that is added to the samples of the intensity stage, as the sensor's noise
    displaces returns: standard deviation, rad (3QFPI: 0)."""


@settings
class TrainingConfig:
    """Losses, schedule and optimiser."""

    start: Literal["noise", "average"] = "noise"
    """What the training starts from: random numbers (3QFP), or the average of the rays' truncated signed
    distances (Curless and Levoy, 1996), which needs an octree."""
    truncation_cells: _Positive = 3.0
    """For that average: distances are truncated here, and a ray counts up to this far before and behind its
    return, in leaf cells (VDBFusion: 3 voxels). Measured: 4 and 5 are as good on simulated scenes, 0.5 and
    1.2 points worse on real ones."""
    sigma_cells: _Positive = 0.5
    """Scale of the sigmoid from signed distance to occupancy, in leaf cells (3QFP: 0.0275 m). Measured: 0.4
    to 0.75 differ by 0.2 points of F-score on simulated scenes; on real ones 0.4 to 0.5 are 0.4 to 2 points
    better."""
    sdf_loss_weight: _NotNegative = 1.0
    """Weight of the sdf loss in the joint iterations, where that of the intensity loss is 1 (3QFPI: 1). 0 is
    for ablations: features and networks then learn from intensities alone, and there is no surface."""
    intensity_in_free_space: bool = False
    """Whether the intensity network also trains on samples in free space, with the lowest intensity as their
    label (3QFPI: yes). Measured: 10 to 25 % more error."""
    joint: bool = True
    """Whether the intensity network trains during the sdf stage too, and its loss also trains the features
    and the SDF network (3QFPI: yes). These are joint iterations. Otherwise it trains only afterwards, on a
    frozen field. Measured: 1 to 3 % less error in equal time."""
    batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 4096
    """Samples in an iteration of the sdf stage (3QFP: 8192). Measured: more and smaller steps are better."""
    intensity_batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 1024
    """Samples that the intensity network sees in an iteration, unless it sees free space in joint ones (3QFPI:
    8192). Measured: likewise; 2048 take 1.5 to 1.8 times as long, and have 0.3 to 0.7 % less error on simulated
    scenes."""
    sdf_iterations: Annotated[int, Field(ge=0, le=MAX_ITERATIONS)] | None = None
    """Iterations of the sdf stage. It trains features and SDF network, which are then frozen (3QFPI: 1000).
    None: from the size of the data and `effort`. 0: the field stays as it is at the start."""
    intensity_iterations: _Count | None = None
    """Iterations that train the intensity network, joint ones included (3QFPI: 4000). None: likewise."""
    optimiser: Literal["soap", "adam"] = "soap"
    """What moves the weights of the networks: SOAP (Vyas et al., ICLR 2025) or Adam (3QFPI). Features always have Adam.
    Measured: with SOAP, the networks learn as much in a quarter to a half of the iterations."""
    learning_rate: _Positive = 2e-2
    """Learning rate for features and SDF network (3QFPI: 1e-3; 3QFP for radar: 1e-2). Measured with
    `row_updates`: 2e-2 gives 0.0 to 0.8 points of F-score more than 1e-2 on real scans, and 0.1 more or less
    on simulated ones."""
    intensity_learning_rate: _Positive = 1e-2
    """Learning rate for the intensity network (3QFPI: 1e-3). Measured: with Adam, 6e-3 is better."""
    cosine_schedule: bool = True
    """Whether the learning rates fall to zero along a cosine in each stage (3QFPI: no, they are constant)."""
    row_updates: bool = True
    """Whether an iteration changes only the features that its samples use. Otherwise Adam's momentum changes
    the others too (3QFP). Joint iterations with `normals` always change all features."""
    gradients: Literal["core", "autograd"] = "core"
    """What computes losses and gradients: the compiled core in one call, or PyTorch's autograd, which is the
    reference and takes two to three times as long. With `normals` it is always autograd."""


_Group = ReturnsConfig | EncodingConfig | NetworksConfig | SamplingConfig | TrainingConfig


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
    >>> config.training.sdf_iterations, config.near_band_m
    (200, 0.45)
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
    returns: Annotated[ReturnsConfig, BeforeValidator(_from_mapping(ReturnsConfig))] = ReturnsConfig()
    """Which returns are used, and how they are cleaned."""
    encoding: Annotated[EncodingConfig, BeforeValidator(_from_mapping(EncodingConfig))] = EncodingConfig()
    """How a position is encoded for the networks."""
    networks: Annotated[NetworksConfig, BeforeValidator(_from_mapping(NetworksConfig))] = NetworksConfig()
    """The two networks and their inputs."""
    sampling: Annotated[SamplingConfig, BeforeValidator(_from_mapping(SamplingConfig))] = SamplingConfig()
    """Where on the rays the training samples are."""
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
            # A vertex of the map that no ray counts at would keep the distance 0, that of the surface.
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

    @property
    def lattice(self) -> WorldLattice:
        """Where cells lie in the world, from leaf cells to the coarsest."""
        return WorldLattice(self.leaf_size_m, max(BLOCK_CELLS, 2 ** (self.encoding.num_levels - 1)))

    @property
    def preparation(self) -> dict[str, Any]:
        """Keyword arguments of :func:`radarsdf.returns.rays.prepare`."""
        names = ("min_range_m", "max_range_m", "accumulate_scans")
        return {name: getattr(self.returns, name) for name in names} | {"lattice": self.lattice}

    @property
    def trains_intensity(self) -> bool:
        """Whether intensities, where there are any, train a network."""
        return self.networks.reflectance != "closed-form"

    @property
    def closes_intensity(self) -> bool:
        """Whether intensities, or what a network leaves of them, are in closed form."""
        return self.networks.reflectance != "network"

    def moves_rows(self, with_intensity: bool) -> bool:
        """Whether an iteration changes only the features that its samples use: see `training.row_updates`."""
        # Normals are gradients of the features, which only autograd differentiates again, for all features at
        # once.
        through_normals = with_intensity and self.training.joint and self.networks.normals
        return self.training.row_updates and not through_normals

    def differentiates_in_core(self, with_intensity: bool) -> bool:
        """Whether the gradients come from the compiled core: see `training.gradients`."""
        # Normals are gradients, and the core does not differentiate twice.
        normals = with_intensity and self.networks.normals
        return self.training.gradients == "core" and not normals

    def _metres(self, cells: float) -> float:
        return float(f"{cells * self.leaf_size_m:.12g}")  # 1.5 · 0.2 gives 0.3, not 0.30000000000000004

    @classmethod
    def quick(cls, **changes: Any) -> FitConfig:
        """Settings for a surface that is averaged over the rays instead of trained.

        The fit takes a fraction of the time; the surface is rougher and the map larger. Mesh it with voxels of the
        size of its leaf cells, since smaller ones show no more detail. Intensities are in closed form, and take a
        quarter to a half of the time without them. `changes`: as for :meth:`override`.
        """
        return cls(
            encoding=EncodingConfig(kind="octree", num_levels=1, fourier_count=0, bridge_cells=0),
            networks=NetworksConfig(sdf_hidden=(2,), reflectance="closed-form"),
            sampling=SamplingConfig(near_band_cells=2.0),
            training=TrainingConfig(start="average", sdf_iterations=0, joint=False),
        ).override(**changes)

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """The settings of 3QFPI as published. `changes`: as for :meth:`override`.

        For a mesh as published, call ``mesh(min_detection_rate=0, max_uncertainty=math.inf, min_component_triangles=300)``.
        """
        return cls(
            returns=ReturnsConfig(
                accumulate_scans=5, drop_movers=False, drop_ghosts=False, onto_planes=False
            ),
            encoding=EncodingConfig(bridge_cells=0, fourier_count=16),
            networks=NetworksConfig(
                intensity_hidden=(64, 64),
                geometry_feature_dim=15,
                reflectance="network",
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
                optimiser="adam",
                learning_rate=1e-3,
                intensity_learning_rate=1e-3,
                cosine_schedule=False,
                row_updates=False,
            ),
        ).override(**changes)

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
                merged[name] = type(group)(**(own | by_name(value, name)))
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
