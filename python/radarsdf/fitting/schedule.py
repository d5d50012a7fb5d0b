"""Batch sizes and iterations of a fit, from the configuration and the size of the data."""

from __future__ import annotations

import math
from dataclasses import dataclass

from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.sampling import FREE_SAMPLES, NEAR_SAMPLES

# Passes of the sdf stage over the samples, within the limits below. If these conflict, the minimum number of iterations
# takes precedence over the maximum of passes and of samples. Measured with SOAP: 0.6 of Adam's iterations are as good to
# 0.1 points of F-score; half of the passes lose 0.2.
_SDF_PASSES = 0.6
_LEAST_SDF_ITERATIONS = 150  # with fewer, the surface of a small scene is unfinished
_ENOUGH_SDF_ITERATIONS = 180  # with fewer, the networks have not converged
_MOST_SDF_PASSES = 1.2  # with more over few returns, the field memorises their noise
_MOST_SAMPLES_PER_VERTEX = 20.0
# If the limit on samples allows more iterations than this, half of it. Measured on `hugin` and `oculii` with 600 scans and
# on eight `hugin` side by side: 0.0 to 0.1 points of F-score less in half the training.
_MANY_SDF_ITERATIONS = 300
# Beyond this, batches grow: one of the usual size covers little of so large a map.
_MOST_SDF_ITERATIONS = 5000
# Rows of features beyond which they and the state of their optimiser, 64 bytes, exceed the caches. Batches then consist of
# runs of neighbouring rays, which share rows. Measured: iterations at two million returns take 0.8 of the time. On `hugin`,
# where it gains nothing, F-scores fall by 0.04 points and intensities are 0.4 % worse.
_ROWS_IN_CACHES, _NEIGHBOURS = 500_000, 8

# Passes of the intensity network's training over the samples near the surface, joint iterations included, within the
# limits below. Measured with SOAP: 0.4 of Adam's iterations have the same error to 0.4 %.
_INTENSITY_PASSES = 0.65
_LEAST_INTENSITY_ITERATIONS = 500  # with fewer, it has not converged on a small scene
_MOST_INTENSITY_ITERATIONS = 1750
# Minimum after the joint iterations, during which the field still changes.
_LEAST_INTENSITY_STAGE = 300
# Beyond this, iterations of the sdf stage that train the surface alone are interspersed.
_MOST_JOINT_ITERATIONS = _MOST_INTENSITY_ITERATIONS - _LEAST_INTENSITY_STAGE

_HALF_DROPOUT_PASSES = 2.5  # uses of each sample at which dropout has half of the configured rate


@dataclass(frozen=True)
class Schedule:
    """Batch sizes and iterations of the sdf stage and the intensity stage. Joint iterations, of the first, count for both."""

    batch_size: int = 0  # samples in an iteration of the sdf stage
    neighbours: int = 1  # length of the runs of neighbouring rays in a batch
    sdf_iterations: int = 0
    passes: float = 0.0  # passes of the sdf stage over the samples
    joint_iterations: int = 0
    intensity_iterations: int = 0  # iterations that train the intensity network
    intensity_batch_size: int = 0
    dropout_scale: float = 0.0  # factor on the dropout

    @classmethod
    def of(
        cls, config: FitConfig, *, surface_returns: int, returns: int, vertices: int, with_intensity: bool
    ) -> Schedule:
        """Compute the schedule for `surface_returns` returns without ghosts, and `returns` with them."""
        if not config.train:
            return cls()
        training = config.training
        samples = surface_returns * (NEAR_SAMPLES + FREE_SAMPLES)
        batch_size, iterations = training.batch_size, training.sdf_iterations
        if iterations is None:
            batch_size, iterations = _sdf_schedule(config, samples, vertices)
        neighbours = _NEIGHBOURS if min(vertices, surface_returns) > _ROWS_IN_CACHES else 1
        surface = (batch_size, neighbours, iterations, iterations * batch_size / samples)
        if not with_intensity:
            return cls(*surface)
        samples = returns * NEAR_SAMPLES
        intensity_batch_size = training.intensity_batch_size
        joint_iterations, intensity_iterations = iterations, training.intensity_iterations
        if intensity_iterations is None:
            joint_iterations = min(iterations, max(1, round(config.effort * _MOST_JOINT_ITERATIONS)))
            intensity_batch_size = min(intensity_batch_size, samples)
            wanted = math.ceil(_INTENSITY_PASSES * samples / training.intensity_batch_size)
            wanted = min(max(wanted, _LEAST_INTENSITY_ITERATIONS), _MOST_INTENSITY_ITERATIONS)
            alone = max(wanted - joint_iterations, _LEAST_INTENSITY_STAGE)
            intensity_iterations = max(1, joint_iterations + round(config.effort * alone))
        if training.intensity_in_free_space:  # the samples are those of the sdf stage
            intensity_batch_size = batch_size
        # A frequently used sample is easily memorised. Measured: constant dropout for all scenes (0.7 and 0.2)
        # is as good on sparse ones, but costs 2 % on a dense one, which uses its samples twice.
        times_used = intensity_iterations * intensity_batch_size / samples
        dropout_scale = times_used / (times_used + _HALF_DROPOUT_PASSES)
        return cls(*surface, joint_iterations, intensity_iterations, intensity_batch_size, dropout_scale)

    @property
    def iterations(self) -> dict[str, int]:
        return {"sdf": self.sdf_iterations, "intensity": self.intensity_iterations}


def _sdf_schedule(config: FitConfig, samples: int, vertices: int) -> tuple[int, int]:
    # With few returns, a batch of more than one pass is redundant. Measured on 20 to 300 returns of four simulated
    # scenes: errors are as small, and 20 take a quarter of the time.
    batch_size = min(config.training.batch_size, samples)
    one_pass = samples / batch_size
    wanted = max(_SDF_PASSES * one_pass, min(_ENOUGH_SDF_ITERATIONS, _MOST_SDF_PASSES * one_pass))
    most = _MOST_SAMPLES_PER_VERTEX * vertices / batch_size
    wanted = min(wanted, max(min(most, _MANY_SDF_ITERATIONS), most / 2))
    iterations = max(1, round(config.effort * max(_LEAST_SDF_ITERATIONS, math.ceil(wanted))))
    if iterations <= _MOST_SDF_ITERATIONS:
        return batch_size, iterations
    return math.ceil(batch_size * iterations / _MOST_SDF_ITERATIONS), _MOST_SDF_ITERATIONS
