# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every choice of a fit, with its unit and its source."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from typing import Any, Literal

MAX_LEVELS = 12  # of the compiled core
MAX_FREQUENCIES = 24
MAX_THREADS = 1024
MAX_LAYERS = 32
MAX_WIDTH = 4096  # of a layer: far beyond what a map of a scene can use
MAX_SAMPLES = 2**24  # in a batch, or of a return
MAX_DROPOUT = 0.95
MAX_BRIDGE_CELLS = 8  # more would take time with their square, and join what does not belong together
MAX_SEED = 2**48  # each thread draws from a generator of its own, numbered from the seed on

_TINY, _HUGE = sys.float_info.min, sys.float_info.max
_POSITIVE, _FROM_0, _FROM_1 = (_TINY, _HUGE), (0, _HUGE), (1, _HUGE)
_RANGES: dict[str, tuple[float, float]] = {
    "min_range_m": _FROM_0,
    "accumulate_frames": _FROM_1,
    "leaf_size_m": _POSITIVE,
    "num_levels": (1, MAX_LEVELS),
    "feature_std": _POSITIVE,
    "bridge_cells": (0, MAX_BRIDGE_CELLS),
    "fourier_half_width_m": _POSITIVE,
    "fourier_first": _FROM_0,
    "fourier_count": _FROM_0,
    "geometry_feature_dim": (0, MAX_WIDTH),
    "feature_dropout": (0, MAX_DROPOUT),
    "fourier_dropout": (0, MAX_DROPOUT),
    "near_samples": (1, MAX_SAMPLES),
    "free_samples": (0, MAX_SAMPLES),
    "near_band_m": _POSITIVE,
    "truncation_m": _POSITIVE,
    "free_from": (0, 1 - sys.float_info.epsilon),
    "free_beyond_m": _FROM_0,
    "cross_range_noise_rad": _FROM_0,
    "sigma_m": _POSITIVE,
    "sdf_loss_weight": _FROM_0,
    "batch_size": (1, MAX_SAMPLES),
    "sdf_iterations": _FROM_0,
    "sdf_passes": _POSITIVE,
    "min_sdf_iterations": _FROM_1,
    "enough_sdf_iterations": _FROM_1,
    "max_sdf_passes": _POSITIVE,
    "max_samples_per_vertex": _POSITIVE,
    "max_sdf_iterations": _FROM_1,
    "intensity_batch_size": (1, MAX_SAMPLES),
    "intensity_iterations": _FROM_1,
    "intensity_passes": _POSITIVE,
    "min_intensity_iterations": _FROM_1,
    "max_reflectance_iterations": _FROM_0,
    "learning_rate": _POSITIVE,
    "intensity_learning_rate": _POSITIVE,
    "adam_epsilon": _POSITIVE,
    "min_support": _FROM_0,
    "min_component_triangles": _FROM_0,
    "seed": (0, MAX_SEED),
    "num_threads": (0, MAX_THREADS),
    "max_memory_bytes": _FROM_1,
}


def _has_type(value: Any, annotation: str) -> bool:
    """Settings come from the command line and from files, and a word for a number should not surface in a kernel."""
    if annotation.endswith(" | None"):
        return value is None or _has_type(value, annotation.removesuffix(" | None"))
    match annotation:
        case "bool":
            return isinstance(value, bool)
        case "int":
            return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
        case "float":
            return isinstance(value, float) or _has_type(value, "int")
        case "tuple[int, ...]":
            return isinstance(value, tuple) and all(_has_type(item, "int") for item in value)
        case _:
            return True


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How a map is fitted. The defaults are those measured to be best; :meth:`paper` is 3QFPI as published.

    "3QFP" and "3QFPI" below name the papers (ICRA 2024; Neural Surface and Reflectance Modelling from 3D Radar Data)
    and their published radar configuration. "measured" stands for measurements on simulated and real scans; most of the
    figures are in ``BENCHMARK.md`` and ``bench/README.md``.

    Raises
    ------
    ValueError
        At construction, for a value that makes no sense.
    """

    # Preparation
    min_range_m: float = 2.5
    """Returns nearer than this are dropped as near-field clutter, m (3QFPI: 2.5, for the Oculii sensor 1)."""
    max_range_m: float | None = None
    """Returns further than this are dropped, m. None: none are."""
    accumulate_frames: int = 1
    """Consecutive scans treated as one, all seen from the middle one's position. 3QFPI: 5, to densify what it feeds
    scan by scan; here a fit sees all returns at once, so each keeps the position that it was really seen from."""

    drop_ghosts: bool = True
    """Whether returns behind a surface that their own rays passed through, as mirrors make them, are dropped (3QFPI: no;
    measured: 84 to 94 % of the surface that they cause gone, and 0.7 % of the true returns). The intensity network
    learns from them all the same."""

    onto_planes: bool = True
    """Whether returns are moved onto the plane through those round them, where these make one, for the SDF network to
    learn from (3QFPI: no; measured: 0.8 to 1.7 points of F-score with nothing discarded on simulated scenes, whole or every
    tenth scan, a tenth less error, and -0.2 to 0.5 on real ones; up to 1 % more error of held-out intensities)."""

    # Encoding
    encoding: Literal["tri-quadtree", "octree"] = "tri-quadtree"
    """Where the features live: on three planes (3QFP) or in space (SHINE-Mapping)."""
    leaf_size_m: float = 0.2
    """Edge of the finest cells, m (3QFPI)."""
    num_levels: int = 3
    """Levels of cells, each twice as large as the one before (3QFP)."""
    feature_std: float = 0.05
    """Standard deviation of the features at the start (3QFP)."""
    bridge_cells: int = 4
    """Cells in a row without a return that become part of the map where they lie between two cells with returns, neither
    of them badly supported and not both dense; 0: none (3QFP). Four are as wide as a cell of the third level, over which
    its features interpolate (measured: 0.8 to 3.8 points of F-score with nothing discarded on every tenth scan of a scene,
    with `enough_sdf_iterations` 0.5 and 0.8 on real scans, 0.0 to -0.2 on whole simulated ones)."""
    start: Literal["noise", "average"] = "noise"
    """What training starts from: noise (3QFP), or the rays' average of truncated distances, which only an octree holds."""
    truncation_m: float = 0.6
    """How far before and behind its return a ray counts in that average, and where it cuts distances, m (VDBFusion:
    three voxels of 0.2 m; measured: 0.8 and 1.0 are as good on simulated scenes, 0.5 and 1.2 points worse on real ones)."""
    fourier_half_width_m: float = 409.6
    """Half of the longest Fourier wavelength, m (3QFP: 2^12 · 0.2 m / 2)."""
    fourier_first: int = 0
    """First frequency k: the wavelength is 2 · half width / 2^k (3QFP: 0)."""
    fourier_count: int = 10
    """Number of frequencies (3QFP: 16). The tenth's wavelength, 1.6 m, spans the coarsest cells, inside which the features
    take over; finer ones, down to 2.5 cm, are noise to learn by heart."""

    # Networks
    sdf_hidden: tuple[int, ...] = (32, 32)
    """Widths of the hidden layers of the SDF network (3QFP)."""
    intensity_hidden: tuple[int, ...] = (64, 64, 64)
    """Widths of the hidden layers of the intensity network (3QFPI: 64, 64; measured: a third is worth 1 to 3 %)."""
    geometry_feature_dim: int = 0
    """Numbers handed from the SDF to the intensity network (3QFPI: 15; its ablation: no worth)."""
    normals: bool = False
    """Whether the intensity network sees the surface normal (3QFPI: yes; its ablation: no worth)."""
    sdf_input: bool = True
    """Whether the intensity network sees the SDF (3QFPI)."""
    view_direction: bool = True
    """Whether the intensity network sees the viewing direction (3QFPI)."""
    log_range: bool = True
    """Whether it sees log10(range / 10 m), as the radar equation's r^-4 asks for (3QFPI: no; measured: 5 to
    10 % less error, and nothing lost where a sensor compensates for the range)."""
    feature_dropout: float = 0.85
    """Share of the cells' features hidden from the intensity network where its training sees each sample very often,
    drawn anew for each sample; where it sees each n times, n / (n + 3) of this, since what there are few of can be
    learnt by heart (3QFPI: 0; measured, with the next: 0 to 2 % less error on full simulated scenes, 7 to 8 % on short
    ones, 1 to 3 % on real ones; costs the surface of a sparse scene 0.3 points of F-score)."""
    fourier_dropout: float = 0.25
    """The same for the Fourier encoding (3QFPI: 0)."""

    # Samples
    near_samples: int = 6
    """Samples near the surface for every return (3QFPI)."""
    free_samples: int = 6
    """Samples in free space for every return (3QFPI)."""
    near_band_m: float = 0.3
    """Samples near the surface are uniform within this distance of the return, m (3QFP)."""
    free_from: float = 0.3
    """Free-space samples start at this share of the range (3QFP)."""
    free_beyond_m: float = 0.8
    """... and end this far behind the return, m (3QFP)."""

    cross_range_noise_rad: float = 0.005
    """Samples for the intensity are spread across the beam by this angle times the range, one standard deviation, as the
    sensor's angular noise spreads returns (3QFPI: 0)."""

    # Losses
    sigma_m: float = 0.15
    """Scale of the sigmoid that turns distances into occupancy, m (3QFP: 0.55 · 0.05; measured for radar: 0.1 to 0.2)."""
    sdf_loss_weight: float = 1.0
    """Weight of the SDF's loss beside that of the intensity in a joint fit (3QFPI: equal weights). With 0, features and
    intensity network learn from intensities alone, and there is no surface: for ablations."""
    intensity_in_free_space: bool = False
    """Whether free-space samples are labelled with the lowest intensity (3QFPI: yes; measured: 10 to 25 % worse)."""

    # Schedule
    batch_size: int = 4096
    """Samples in an iteration of SDF network and features (3QFP: 8192; measured: half of it, twice as often, goes
    further)."""
    sdf_iterations: int | None = None
    """Iterations of SDF network and features, which are then frozen (3QFPI: 1000). None: as many as the next six say. 0:
    what it starts from stays."""
    sdf_passes: float = 1.0
    """Times each sample is seen (measured: more fits the noise)."""
    min_sdf_iterations: int = 150
    """Fewer leave the surface of a small scene unfinished."""
    enough_sdf_iterations: int = 300
    """Fewer are made up to so many, as far as `max_sdf_passes` lets them: the networks have not converged (measured:
    0.8 points of F-score with nothing discarded on `hugin(seed=1, frames=30)`, 0.3 on a real scene, no loss)."""
    max_sdf_passes: float = 2.0
    """Times each sample is seen at most on the way to `enough_sdf_iterations`: beyond, the noise of a scene of few returns
    is learnt by heart (3 cost 0.6 points on `oculii(seed=1, frames=40)`, 13 cost 1.4 on a tenth of `oculii`)."""
    max_samples_per_vertex: float = 32.0
    """So many samples for each vertex of a cell are enough, however many returns there are (measured: `wall`, with 100 in a
    pass, is as good after 20)."""
    max_sdf_iterations: int = 5000
    """Where more would be needed, batches grow instead: a batch hardly touches so large a map."""
    intensity_batch_size: int = 2048
    """Samples in an iteration of the intensity network (3QFPI: 8192; measured: more and smaller steps go further)."""
    intensity_iterations: int | None = None
    """Iterations of the intensity network, those of a joint beginning included (3QFPI: 4000). None: `intensity_passes`
    over the data, but at least `min_intensity_iterations` and, once the geometry is finished, at most
    `max_reflectance_iterations`."""
    intensity_passes: float = 1.0
    """Times each near-surface sample is seen where `intensity_iterations` is None."""
    min_intensity_iterations: int = 1200
    """Fewer leave the reflectance of a small scene unfinished."""
    max_reflectance_iterations: int = 4000
    """So many on the finished geometry are enough, however many returns there are (measured: of 2 million returns of `hugin`,
    174, 974, 2974 and 4288 give errors of 2.89, 2.83, 2.80 and 2.80 dB)."""
    joint: bool = True
    """Whether the intensity network trains from the first iteration on, its gradient reaching features and SDF network
    until these freeze (3QFPI; measured: 1 to 3 % less error for the same time), or only on the finished geometry."""
    learning_rate: float = 2e-2
    """Adam's (3QFPI: 1e-3; 3QFP's radar configuration: 1e-2; measured: twice that where only touched features move, 0.0 to
    0.8 points of F-score with nothing discarded on real scans, 0.1 either way on simulated ones)."""
    intensity_learning_rate: float = 7e-3
    """Adam's for the intensity network (3QFPI: 1e-3)."""
    cosine_schedule: bool = True
    """Whether the learning rates fall to zero along a cosine (3QFPI: constant)."""
    adam_epsilon: float = 1e-15
    """Adam's (3QFP)."""
    row_updates: bool = True
    """Whether an iteration moves only the features that its samples touch, instead of all by their fading momentum
    (3QFP: no). With `normals` in a joint fit, all move in any case."""

    # Mesh
    min_support: float = 0.12
    """The mesh leaves out what fewer returns support than this share of the median (3QFP: 0). A share, since what is much
    for a sparse sensor is little for a dense one."""
    min_component_triangles: int = 30
    """Smaller components of a mesh are dropped (3QFP: 300, which on sparse scans costs ten points of completion. What 30
    would let in, `min_support` keeps out)."""

    # Machine
    seed: int = 0
    """Seed of every random number of the fit: same seed, data and number of threads, same bits."""
    num_threads: int = 0
    """Threads; 0: as many as PyTorch uses."""
    max_memory_bytes: int | None = None
    """A fit or mesh that by its estimate takes more is refused, by a MemoryError. None: what the system has."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not _has_type(value := getattr(self, field.name), str(field.type)):
                msg = f"{field.name} must be {field.type}, not {value!r:.50}"
                raise ValueError(msg)
        for name, (lowest, highest) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not lowest <= value <= highest:
                lower = "positive" if lowest == _TINY else f"at least {lowest}"
                upper = "finite" if highest == _HUGE else f"at most {highest:g}"
                msg = f"{name} must be {lower} and {upper}, not {value}"
                raise ValueError(msg)
        if self.encoding not in ("tri-quadtree", "octree"):
            msg = f"encoding must be 'tri-quadtree' or 'octree', not {self.encoding!r}"
            raise ValueError(msg)
        if self.start not in ("noise", "average"):
            msg = f"start must be 'noise' or 'average', not {self.start!r}"
            raise ValueError(msg)
        if self.start == "average":
            self._check_average()
        if self.fourier_first + self.fourier_count > MAX_FREQUENCIES:
            msg = f"only frequencies below {MAX_FREQUENCIES} are possible"
            raise ValueError(msg)
        if self.max_range_m is not None and not self.max_range_m > self.min_range_m:
            msg = f"max_range_m must exceed min_range_m, not {self.max_range_m}"
            raise ValueError(msg)
        if not (
            self.sdf_hidden and self.intensity_hidden and min(self.sdf_hidden + self.intensity_hidden) > 0
        ):
            msg = "networks need at least one hidden layer, of positive width"
            raise ValueError(msg)
        for widths in (self.sdf_hidden, self.intensity_hidden):
            if len(widths) > MAX_LAYERS or max(widths) > MAX_WIDTH:
                msg = f"networks have at most {MAX_LAYERS} hidden layers, of at most {MAX_WIDTH}, not {widths!s:.50}"
                raise ValueError(msg)

    def _check_average(self) -> None:
        if self.encoding != "octree" or min(self.sdf_hidden, default=0) < 2:
            msg = "start='average' needs encoding='octree' and hidden layers of at least two"
            raise ValueError(msg)
        if (
            self.truncation_m < self.near_band_m
        ):  # vertices that no ray counts at would seem to lie on the surface
            msg = f"truncation_m must be at least near_band_m, {self.near_band_m}, not {self.truncation_m}"
            raise ValueError(msg)

    @classmethod
    def quick(cls, **changes: Any) -> FitConfig:
        """An average instead of a trained surface, with `changes` on top: rougher, larger, and there in a fraction of the time.

        Mesh it with voxels of 0.2 m, the size of its cells: finer ones show no more.
        """
        values: dict[str, Any] = {
            "encoding": "octree",
            "num_levels": 1,
            "fourier_count": 0,
            "bridge_cells": 0,
            "min_support": 0.15,
            "sdf_hidden": (2,),
            "near_band_m": 0.4,
            "start": "average",
            "sdf_iterations": 0,
            "joint": False,
        }
        return cls(**(values | changes))

    @classmethod
    def paper(cls, **changes: Any) -> FitConfig:
        """3QFPI's configuration as published, with `changes` on top."""
        values: dict[str, Any] = {
            "accumulate_frames": 5,
            "drop_ghosts": False,
            "onto_planes": False,
            "bridge_cells": 0,
            "fourier_count": 16,
            "cross_range_noise_rad": 0.0,
            "batch_size": 8192,
            "intensity_batch_size": 8192,
            "geometry_feature_dim": 15,
            "normals": True,
            "log_range": False,
            "feature_dropout": 0.0,
            "fourier_dropout": 0.0,
            "sigma_m": 0.55 * 0.05,
            "intensity_hidden": (64, 64),
            "intensity_in_free_space": True,
            "sdf_iterations": 1000,
            "intensity_iterations": 4000,
            "min_support": 0.0,
            "min_component_triangles": 300,
            "learning_rate": 1e-3,
            "intensity_learning_rate": 1e-3,
            "cosine_schedule": False,
            "row_updates": False,
        }
        return cls(**(values | changes))

    @property
    def preparation(self) -> dict[str, Any]:
        """What :func:`radarsdf.returns.rays.prepare` is told for a fit."""
        names = ("min_range_m", "max_range_m", "accumulate_frames")
        return {name: getattr(self, name) for name in names}

    def to_dict(self) -> dict[str, Any]:
        """Plain values only, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> FitConfig:
        """The inverse of :meth:`to_dict`; an unknown key is a ValueError."""
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := sorted(set(values) - known):
            msg = f"unknown settings: {', '.join(unknown)}"
            raise ValueError(msg)
        settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**settings)
