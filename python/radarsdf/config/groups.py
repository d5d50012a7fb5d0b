"""The groups of settings of a fit, with unit, range and source.

"3QFP" (ICRA 2024) and "3QFPI" (Neural Surface and Reflectance Modelling from 3D Radar Data) are the papers
and their published settings for radar. "Measured" means measured on simulated and real scans;
``docs/defaults.md`` lists the gains. Lengths that end in ``_cells`` are in leaf cells, so they scale with `leaf_size_m`.
"""

from typing import Annotated, Literal

from pydantic import Field

from radarsdf.checks import check
from radarsdf.settings import settings

MAX_FREQUENCIES = 24  # Fourier frequencies that the compiled core allows; a test compares the two numbers
MAX_THREADS = 1024
MAX_LAYERS = 32  # hidden layers of a network
MAX_SAMPLES = 2**24  # samples per batch, and samples per return
MAX_ITERATIONS = 2**31 - 1  # the core counts iterations in 32 bits
_MAX_BRIDGE_CELLS = 8  # the run time grows with the square, and longer bridges join separate surfaces
_MAX_WIDTH = 4096  # units of a layer: far more than a map of a scene can use

_MAX_NOISE_M, _MAX_NOISE_RAD = 100, 1
_NoiseM = Annotated[float, Field(gt=0, le=_MAX_NOISE_M)]
_NoiseRad = Annotated[float, Field(gt=0, le=_MAX_NOISE_RAD)]
_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]
_Count = Annotated[int, Field(ge=1, le=MAX_ITERATIONS)]
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
    """Number of consecutive scans treated as seen from the position of the middle one (3QFPI: 5, since it
    trains scan by scan). 1 is enough here: a fit trains on all scans at once."""
    drop_moving: bool = True
    """Whether to drop returns whose Doppler velocity, if measured, contradicts a static world (3QFPI: no). Measured:
    0.1 to 8.6 points of F-score on five real drives, 5.9 on a simulated street with cars, 0.0 on one without."""
    drop_ghosts: bool = True
    """Whether to fit the surface without ghosts: returns behind a surface that their rays crossed, such as
    reflections in mirrors (3QFPI: no). Measured on twelve kinds of simulated scenes: it removes half to three quarters of
    the ghosts, and 0 to 2 % of the true returns (6 % along fences). Intensities are still fitted with them."""
    range_noise_m: _NoiseM | None = None
    """Standard deviation of a return along the beam, m. None: estimated from the returns; see
    :func:`radarsdf.returns.noise.sensor_noise`."""
    azimuth_noise_rad: _NoiseRad | None = None
    """Standard deviation of a return in azimuth, rad. None: estimated."""
    elevation_noise_rad: _NoiseRad | None = None
    """Standard deviation of a return in elevation, rad. None: estimated."""
    pose_sigma_m: Annotated[float, Field(ge=0, le=_MAX_NOISE_M)] = 0.0
    """Standard deviation of the position of a scan, m. All returns of a scan share the error, so only more
    scans reduce it. It enters the uncertainty, and the weights with which distances are smoothed."""
    pose_sigma_rad: Annotated[float, Field(ge=0, le=_MAX_NOISE_RAD)] = 0.0
    """Standard deviation of the orientation of a scan, rad. It displaces a return in proportion to its range."""
    onto_planes: bool = True
    """Whether to move each return towards the surfel of its cell, a plane through the returns there (3QFPI: no). Measured:
    0.8 to 1.7 points of F-score on simulated scenes, -0.9 to 0.5 on real ones; up to 1 % more error of intensities."""
    free_space: bool = True
    """Whether the map provides free-space crossings, and mean intensities by place and view, for :func:`radarsdf.grid` and
    :func:`radarsdf.compare`. They are computed on first use or on saving, in 1 to 5 µs of CPU time per return; until then
    the map keeps the rays, 40 bytes each. They take 0.3 kB per block of 8 × 8 × 8 leaf cells that rays crossed."""

    def __post_init__(self) -> None:
        wrong = f"returns.max_range_m must exceed min_range_m, {self.min_range_m}, not {self.max_range_m}"
        check(self.max_range_m is None or self.max_range_m > self.min_range_m, wrong)


@settings
class EncodingConfig:
    """How a position is encoded for the networks."""

    kind: Literal["tri-quadtree", "octree"] = "tri-quadtree"
    """Where the features are: on quadtrees in three planes (3QFP) or on an octree (SHINE-Mapping)."""
    bridge_cells: Annotated[int, Field(ge=0, le=_MAX_BRIDGE_CELLS)] = 4
    """Gaps of at most this many empty leaf cells between two cells with returns become part of the map (3QFP: 0). Four are
    as wide as a cell of the third level, so its features interpolate across the gap. Measured: 0.8 to 3.8 points of
    F-score on every tenth scan of a scene, 0.5 and 0.8 on real scans, 0.0 to -0.2 on whole simulated scenes."""
    fourier_count: Annotated[int, Field(ge=0, le=MAX_FREQUENCIES)] = 10
    """Number of Fourier frequencies (3QFP: 16). The tenth has a wavelength of 8 leaf cells, twice the edge of
    the coarsest cells; details inside these are left to the features. Shorter wavelengths fit the noise."""


@settings
class NetworksConfig:
    """The two networks and their inputs."""

    intensity_hidden: _Widths = (64, 64, 64)
    """Widths of the hidden layers of the intensity network (3QFPI: 64, 64). Measured: the third gives 1 to 3
    % less error."""
    geometry_feature_dim: Annotated[int, Field(ge=0, le=_MAX_WIDTH)] = 0
    """Size of the feature vector from the SDF network to the intensity network (3QFPI: 15; its ablation shows no gain)."""
    reflectance: Literal["network", "closed-form", "both"] = "both"
    """Model of the intensities: the intensity network (3QFPI); in closed form, regressions on range, elevation and
    incidence, plus means of their residuals in cells; or both: the mean of the network's prediction and of half of
    it plus a closed-form fit of the residual. Measured: both have 2 to 3 % less error than the network on real
    drives, and 7 % less to 0.4 % more on simulated scenes; the file is a fifth to two fifths larger. The closed
    form alone takes 0.03 to 0.1 s instead of seconds. It has 0 to 2 % less error than the network on real drives,
    and mostly 1 to 10 % more on simulated scenes."""
    normals: bool = False
    """Whether the intensity network sees the surface normal (3QFPI: yes; its own ablation shows no gain)."""
    view_direction: bool = True
    """Whether the intensity network sees the viewing direction (3QFPI)."""
    dropout: bool = True
    """Whether to drop features and Fourier encoding at random before the intensity network (3QFPI: no). Measured: 0 to
    2 % less error on long simulated scenes, 7 to 8 % on short ones, 1 to 3 % on real ones."""
    log_range: bool = True
    """Whether the intensity network sees log10(range / 10 m), since the received power falls with r^-4
    (3QFPI: no). Measured: 5 to 10 % less error, and no loss for a sensor that compensates for the range."""


@settings
class TrainingConfig:
    """Losses, schedule and optimiser."""

    sigma_cells: _Positive = 0.5
    """Scale of the sigmoid from signed distance to occupancy, in leaf cells (3QFP: 0.0275 m). Measured: 0.4 to 0.75 differ
    by 0.2 points of F-score on simulated scenes; 0.4 to 0.5 are 0.4 to 2 points better on real ones."""
    intensity_in_free_space: bool = False
    """Whether the intensity network also trains on samples in free space, with the lowest intensity as their
    label (3QFPI: yes). Measured: 10 to 25 % more error."""
    batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 4096
    """Samples in an iteration of the sdf stage (3QFP: 8192). Measured: more, smaller steps are better."""
    intensity_batch_size: Annotated[int, Field(ge=1, le=MAX_SAMPLES)] = 1024
    """Samples of the intensity network in an iteration, unless it sees free space in the sdf stage (3QFPI: 8192). Measured:
    more, smaller steps are better; 2048 take 1.5 to 1.8 times as long, for 0.3 to 0.7 % less error on simulated scenes."""
    sdf_iterations: _Count | None = None
    """Iterations of the sdf stage. It trains features and SDF network, which are then frozen (3QFPI: 1000).
    None: from the size of the data and `effort`."""
    intensity_iterations: _Count | None = None
    """Iterations that train the intensity network, including those of the sdf stage that train both (3QFPI: 4000).
    None: from the size of the data and `effort`."""
    cross_range_noise_rad: _NotNegative = 0.005
    """Standard deviation of the noise across the beam that is added to the samples of the intensity stage, since the
    sensor's noise displaces returns, rad (3QFPI: 0)."""
    optimiser: Literal["soap", "adam"] = "soap"
    """`"soap"`: SOAP (Vyas et al., ICLR 2025) for the networks, Adam for the features that a batch uses, with learning rates
    that decay to zero along a cosine in each stage. `"adam"`: Adam for all, with constant learning rates (3QFPI). Measured: with
    SOAP, the networks need a quarter to a half of the iterations."""
    learning_rate: _Positive = 2e-2
    """Learning rate for features and SDF network (3QFPI: 1e-3; 3QFP for radar: 1e-2). Measured with SOAP: 2e-2 gives 0.0 to
    0.8 points of F-score more than 1e-2 on real scans, and within 0.1 of it on simulated ones."""
    intensity_learning_rate: _Positive = 1e-2
    """Learning rate for the intensity network (3QFPI: 1e-3). Measured: with Adam, 6e-3 is better."""
