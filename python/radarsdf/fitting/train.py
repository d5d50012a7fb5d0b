"""Training of a field. First the surface, then reflectance on the frozen surface."""

import functools
import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from radarsdf.arrays import Array
from radarsdf.checks import check, hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import NeuralField
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.estimate import Schedule
from radarsdf.fitting.sampling import Batch, RaySampler
from radarsdf.fitting.steps import Adam, AutogradGradients, CoreGradients, Gradients, Losses, RowAdam, Soap
from radarsdf.interrupts import deferred_interrupts
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays
from radarsdf.threads import ThreadPool

_GENERATORS = 2  # number of random generators: for samples, for dropout
# Minimum iterations between checks and copies of all parameters, and rows of features per further iteration: of millions
# of rows, a copy every 100 iterations would take a tenth of the training.
_CHECK_EVERY, _ROWS_PER_ITERATION = 100, 4096
_MOST_SPANS = 200  # maximum length of the history of a loss: enough for a plot, small in the file of a map
_KEPT = 0.99  # decay per iteration of the sums that detect divergence: about the last hundred count
_WORST = {
    "sdf": "more than if all distances had the wrong sign",
    "intensity": "more than the whole range of intensities",
}


class Interrupted(KeyboardInterrupt):
    """A fit was interrupted by Ctrl-C.

    Attributes
    ----------
    radar_map : RadarMap or None
        The map so far, usable like any other, with ``iterations_done`` below ``iterations`` in its ``report``.
        None if the training had not begun.
    """

    def __init__(self, radar_map: RadarMap | None = None) -> None:
        super().__init__("interrupted while training" if radar_map else "interrupted before the training")
        self.radar_map = radar_map


class Diverged(FloatingPointError):
    """A loss or a parameter is not finite, or a loss exceeds that of the worst plausible prediction.

    The message names the loss or parameter, the stage and the iteration.

    Attributes
    ----------
    radar_map : RadarMap or None
        The last state that passed the check, at most 100 iterations before; for maps of millions of rows, a thousand.
    """

    radar_map: RadarMap | None = None


class LossHistory:
    """Mean losses in equal spans of the iterations, and detection of divergence."""

    def __init__(self, iterations: Mapping[str, int], config: FitConfig) -> None:
        self._iterations = dict(iterations)
        self._sigma_m = config.sigma_m
        # A row for each span: iterations done, sum of their losses, training time at their end, s.
        self._spans = {name: np.zeros((min(n, _MOST_SPANS), 3)) for name, n in iterations.items()}
        # A row for each loss: exponentially decaying sums of iterations, losses, and losses of the worst plausible prediction.
        self._recent = np.zeros((len(_WORST), 3))

    def start(self) -> None:
        before_s = max((float(spans[:, 2].max(initial=0.0)) for spans in self._spans.values()), default=0.0)
        self._started_s = time.perf_counter() - before_s

    def add(self, losses: Mapping[str, float], done: Mapping[str, int], sdf_m: Array) -> None:
        """Add the losses of an iteration on samples with labels `sdf_m` (B,), m. `done`: iterations done, it included."""
        now_s = time.perf_counter() - self._started_s
        # The cross-entropy of distances with the wrong sign is below 1 + distance / sigma, and the absolute error of
        # intensities from 0 to 1 is at most 1.
        worst = {"sdf": 1 + float(np.abs(sdf_m).mean()) / self._sigma_m, "intensity": 1.0}
        self._recent *= _KEPT
        for row, name in enumerate(_WORST):
            if name in losses:
                self._recent[row] += (1, losses[name], worst[name])
                spans = self._spans[name]
                span = spans[(done[name] - 1) * len(spans) // self._iterations[name]]
                span += (1, losses[name], 0)
                span[2] = now_s

    def fault(self) -> str | None:
        """Describe a loss that exceeds that of the worst plausible prediction over about a hundred iterations, if any."""
        for (count, loss, worst), (name, words) in zip(self._recent, _WORST.items(), strict=True):
            if loss > worst:
                return f"the {name} loss is {loss / count:.3g}, {words},"
        return None

    def to_report(self) -> dict[str, dict[str, list[Any]]]:
        """Return for each loss and span the iterations done at its end, the mean loss and the training time, s."""
        found = {}
        for name, spans in self._spans.items():
            begun = spans[spans[:, 0] > 0]
            if len(begun):
                found[name] = {
                    "iterations": np.cumsum(begun[:, 0]).astype(int).tolist(),
                    "losses": (begun[:, 1] / begun[:, 0]).tolist(),
                    "seconds": begun[:, 2].tolist(),
                }
        return found

    def state(self) -> dict[str, Tensor]:
        return {name: torch.from_numpy(a) for name, a in (*self._spans.items(), ("recent", self._recent))}


@dataclass(frozen=True)
class _Stage:
    name: str
    iterations: int
    joint: int  # iterations of the sdf stage that train the intensity network, too, evenly spread

    def done(self, count: int) -> dict[str, int]:
        """Return how often each loss was trained after `count` iterations of this stage."""
        if self.name == "sdf":
            return {"sdf": count, "intensity": count * self.joint // self.iterations}
        return {"intensity": self.joint + count}

    def losses(self, i: int) -> Losses:
        if self.name == "intensity":
            return "intensity"
        return "joint" if self.done(i + 1)["intensity"] > self.done(i)["intensity"] else "sdf"


class Training:
    """Train `field` in place: the sdf stage on `surface`, then the intensity stage on all `returns`.

    In joint iterations of the sdf stage the intensity network, if any, trains too. Ghosts are not part of the surface,
    but the sensor will see them again, so their intensities are learnt. `scale` is None without intensities.
    """

    def __init__(
        self,
        field: NeuralField,
        surface: Rays,
        returns: Rays,
        scale: IntensityScale | None,
        schedule: Schedule,
        config: FitConfig,
        pool: ThreadPool,
    ) -> None:
        self._field, self._schedule, self._config, self._pool = field, schedule, config, pool
        self.iterations = schedule.iterations
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
        self.history = LossHistory(self.iterations, config)
        network, training = field.intensity_network, config.training
        kind = AutogradGradients if network is not None and config.networks.normals else CoreGradients
        seeds = (config.seed * _GENERATORS + i for i in range(_GENERATORS))
        self._generator, self._of_dropout = (torch.Generator("cpu").manual_seed(seed) for seed in seeds)
        self._backend = kind(field, config, schedule.dropout_scale, self._of_dropout, pool)
        self._scale = None if network is None else scale
        # A sampler copies the rays, so only one exists at a time.
        self._sampler = self._sampler_of(surface)
        # Returns of the intensity stage. None: those of the current sampler.
        self._later = None if returns is surface or self._scale is None else returns
        self._rows: RowAdam | None = None
        self._optimisers: dict[str, Adam | Soap] = {}
        of_network = Soap if training.optimiser == "soap" else Adam
        if config.moves_rows(network is not None):
            self._rows = RowAdam(field.cells, training.learning_rate)
        else:
            self._optimisers["features"] = Adam(field.cells.parameters(), training.learning_rate)
        self._optimisers["sdf"] = of_network(field.sdf_network.parameters(), training.learning_rate)
        if network is not None:
            self._optimisers["intensity"] = of_network(network.parameters(), training.intensity_learning_rate)

    def _sampler_of(self, rays: Rays) -> RaySampler:
        unit = None
        if self._scale is not None and rays.intensities is not None:
            unit = self._scale.to_unit(rays.intensities)
        size, neighbours = self._schedule.batch_size, self._schedule.neighbours
        return RaySampler(rays, self._config, size, self._generator, neighbours, unit, self._pool.num_threads)

    def _draw_from_all_returns(self) -> None:
        if self._later is not None:
            del self._sampler
            self._sampler, self._later = self._sampler_of(self._later), None

    def state(self) -> dict[str, Tensor]:
        """Return all that the rest of the training depends on, between two iterations, without copying tensors."""
        losses = [self.losses.get(name, 0.0) for name in self.iterations_done]
        state = {
            "done": torch.tensor(list(self.iterations_done.values()), dtype=torch.int64, device="cpu"),
            "losses": torch.tensor(losses, dtype=torch.float64, device="cpu"),
            "generator": self._generator.get_state(),
            "backend.generator": self._of_dropout.get_state(),
        }
        state |= {f"sampler.{key}": value for key, value in self._sampler.state().items()}
        return state | self._tensors()

    def _tensors(self) -> dict[str, Tensor]:
        """Return the part of the state that is updated in place."""
        parts: dict[str, Any] = {f"optimiser.{name}": own for name, own in self._optimisers.items()}
        parts |= {"history": self.history} | ({} if self._rows is None else {"rows": self._rows})
        tensors = {f"field.{name}": p.detach() for name, p in self._field.named_parameters()}
        return tensors | {f"{name}.{k}": v for name, own in parts.items() for k, v in own.state().items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore a :meth:`state` of the same fit. Raise a ValueError if it is invalid."""
        done = dict(zip(self.iterations_done, state["done"].tolist(), strict=True))
        fits = all(0 <= done[name] <= self.iterations[name] for name in done)
        check(fits, f"{done} iterations of {self.iterations}")
        self.iterations_done.update(done)
        losses = zip(done, state["losses"].tolist(), strict=True)
        self.losses.update({name: loss for name, loss in losses if done[name]})
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])
        if self._rows is not None:
            self._rows.check_state(done["sdf"])
        if done["intensity"] > self._schedule.joint_iterations:
            self._draw_from_all_returns()
        self._sampler.restore(state["sampler.order_from"], int(state["sampler.next"]))
        self._generator.set_state(state["generator"])  # last, because the sampler changes it
        self._of_dropout.set_state(state["backend.generator"])

    def report(self) -> dict[str, Any]:
        names = ("iterations", "iterations_done", "losses")
        return {name: getattr(self, name) for name in names} | {"loss_history": self.history.to_report()}

    def run(self, progress: bool | None, checkpoint: Checkpoint | None = None) -> None:
        """Run all remaining iterations.

        Raises :class:`Diverged`, with the field reset to the last parameters that passed the check; or after Ctrl-C a
        KeyboardInterrupt, between two iterations.
        """
        shared = self._schedule.joint_iterations
        lengths = {"sdf": self.iterations["sdf"], "intensity": self.iterations["intensity"] - shared}
        stages = [_Stage(name, length, shared) for name, length in lengths.items() if length > 0]
        self.history.start()
        total, done = sum(stage.iterations for stage in stages), sum(map(self._done, stages))
        with (
            tqdm(total=total, initial=done, desc="fit", unit="it", disable=hides_bar(progress)) as bar,
            deferred_interrupts() as interrupted,
        ):
            for stage in stages:
                if stage.name == "intensity":
                    self._field.cells.requires_grad_(False)
                    self._field.sdf_network.requires_grad_(False)
                self._run_stage(stage, bar, interrupted, checkpoint)
            if checkpoint is not None:
                checkpoint.write(self.state())
            if interrupted():  # the training is done, but the program that called the fit should stop too
                raise KeyboardInterrupt

    def _batch(self) -> Batch:
        return self._sampler.batch(self._backend.num_parts(self._schedule.batch_size))

    def _labelled_batch(self) -> Batch:
        """Draw a batch of the intensity stage, after the last one of the sdf stage."""
        self._draw_from_all_returns()
        if self._config.training.intensity_in_free_space:
            return self._batch()
        count = self._schedule.intensity_batch_size
        return self._sampler.spread(count, self._backend.num_parts(count))

    def _done(self, stage: _Stage) -> int:
        return max(0, self.iterations_done[stage.name] - stage.done(0)[stage.name])

    def _run_stage(
        self, stage: _Stage, bar: Any, interrupted: Callable[[], bool], checkpoint: Checkpoint | None
    ) -> None:
        first, iterations = stage.name == "sdf", stage.iterations
        rows, draw = (self._rows, self._batch) if first else (None, self._labelled_batch)
        optimisers = self._optimisers if first else {"intensity": self._optimisers["intensity"]}
        changing = [p for optimiser in optimisers.values() for p in optimiser.parameters]
        if rows is not None:
            changing.append(self._field.cells.features)
        every = max(_CHECK_EVERY, sum(map(len, changing)) // _ROWS_PER_ITERATION)
        good = [p.detach().clone() for p in changing]

        def give_up(fault: str) -> NoReturn:
            for parameter, value in zip(changing, good, strict=True):
                parameter.data.copy_(value)
            msg = f"{fault} at iteration {i} of {iterations} of the {stage.name} stage: a lower learning rate may help"
            raise Diverged(msg)

        ahead: Batch | None = None
        for i in range(self._done(stage), iterations):
            # Each stage starts at the full learning rate, even if an earlier stage used the optimiser.
            cosine = 0.5 * (1 + math.cos(math.pi * i / iterations))
            share = cosine if self._config.training.optimiser == "soap" else 1.0
            stop = interrupted()
            write = checkpoint is not None and (stop or checkpoint.due())
            judge = i % every == every - 1 or i == iterations - 1
            pause = stop or write or judge
            # Samples are not prefetched before the state is written: it would include their draw.
            batch = ahead or draw()
            done, losses = stage.done(i + 1), stage.losses(i)
            found, ahead = self._backend.of(losses, batch, (lambda: None) if pause else draw)
            loss = sum(found.losses.values())
            if not math.isfinite(loss):
                bad = sorted(name for name, value in found.losses.items() if not math.isfinite(value))
                give_up(f"the {' and '.join(bad)} loss is {loss}")
            move_networks = functools.partial(self._move_networks, losses, found, done, share)
            if rows is None:
                move_networks()
            else:
                assert found.touched is not None
                rows.step(found.touched, done["sdf"], share, self._pool, meanwhile=move_networks)
            self.losses[stage.name] = loss
            for name, count in done.items():
                self.iterations_done[name] = min(count, self.iterations[name])
            self.history.add(found.losses, self.iterations_done, batch.sdf_m)
            # Gradients of all features are as large as the features: free them before the next ones.
            del batch, found, move_networks
            bar.set_postfix_str(f"{stage.name} loss {loss:.3g}", refresh=False)
            bar.update()
            if pause:
                # A sum is finite only if all terms are. Overflow is a fault, too.
                if not all(math.isfinite(float(p.detach().sum())) for p in changing):
                    give_up("a parameter is not finite")
                if judge and (fault := self.history.fault()):
                    give_up(fault)
                for parameter, value in zip(changing, good, strict=True):
                    value.copy_(parameter.detach())
            if write and checkpoint is not None:
                checkpoint.write(self.state())
            if stop:
                raise KeyboardInterrupt

    def _move_networks(self, losses: Losses, found: Gradients, done: dict[str, int], share: float) -> None:
        total = iter(found.by_parameters)
        pool = self._pool if found.touched is None else None  # which moves rows meanwhile
        for name, optimiser in self._optimisers.items():
            trained = "intensity" if name == "intensity" else "sdf"
            if losses in ("joint", trained):
                own = list(itertools.islice(total, len(optimiser.parameters)))
                optimiser.step(own, done[trained], share, pool)
