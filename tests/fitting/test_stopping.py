# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A fit that ends before its time, by Ctrl-C or by numbers that are not finite, ends soon and hands back what it has."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import Diverged, FitConfig, Interrupted, _core
from radarsdf.fitting.core_gradients import CoreGradients
from radarsdf.fitting.optimiser import Adam
from radarsdf.interrupts import deferred_interrupts
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans

from ..conftest import ground_and_wall

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
LONG = {"training": {"sdf_iterations": 1_000_000, "batch_size": 512}}
HUNG_S = 300.0
"""A process that has not ended by then never will. No test asks how fast it is: the processor may be busy."""


def interrupted_python(code, delay_s=0.0):
    """Runs code and presses Ctrl-C some time after it prints "ready".

    Gives what it prints after the line "stopped", and its exit status.
    """
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    watchdog = threading.Timer(HUNG_S, process.kill)
    watchdog.start()
    try:
        assert process.stdout.readline() == "ready\n"
        time.sleep(delay_s)
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "stopped\n"
        return process.stdout.read(), process.wait()
    finally:
        watchdog.cancel()
        process.kill()
        process.stdout.close()
        process.wait()


# Says "ready" when the optimisers, of which a joint fit has two, have made so many steps.
ANNOUNCED = """
from radarsdf.fitting.optimiser import Adam
step, steps = Adam.step, 0
def announced(*arguments):
    global steps
    steps += 1
    if steps == {steps}:
        print("ready", flush=True)
    step(*arguments)
Adam.step = announced
"""
FIT = (
    ANNOUNCED
    + """
import sys
import radarsdf
from tests.conftest import ground_and_wall
from radarsdf import FitConfig, Interrupted
scene = ground_and_wall()
try:
    radarsdf.fit(scene.points, scene.poses, {intensities}, config=FitConfig(**{config}), progress=False)
except KeyboardInterrupt as error:
    print("stopped", flush=True)
    radar_map = error.radar_map
    done = radar_map.report["iterations_done"]
    assert type(error) is radarsdf.Interrupted
    assert 190 < done["sdf"] < 1_000_000, done
    assert radar_map.report["training_s"] > 0
    assert (radar_map.sdf(scene.poses[:, :3, 3], extrapolate=True) > 0).all()
    assert radar_map.confidence(scene.poses[:, :3, 3]).max() == 0
    assert len(radar_map.mesh(0.2).faces) > 100
    print("a map")
"""
)


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_while_training_hands_back_the_map(threads):
    code = FIT.format(steps=400, intensities="scene.intensities", config=LONG | {"num_threads": threads})
    assert interrupted_python(code) == ("a map\n", 0)


def test_ctrl_c_before_the_training_has_no_map():
    code = """
import numpy as np
import radarsdf
from radarsdf.returns.surfels import Surfels
rng = np.random.default_rng(0)
points = rng.normal(size=(1_000_000, 3))
points *= 300 / np.linalg.norm(points, axis=1, keepdims=True)
ended = []
find_surfels = Surfels.of_sums
def announced(*arguments):
    print("ready", flush=True)
    surfels = find_surfels(*arguments)
    ended.append(surfels)
    return surfels
Surfels.of_sums = announced
try:
    config = radarsdf.FitConfig(num_threads=1)
    radarsdf.fit([points], np.eye(4)[None], config=config, progress=False)
except radarsdf.Interrupted as error:
    print("stopped", flush=True)
    print("no map" if error.radar_map is None else error.radar_map)
    print("after" if ended else "within", "the search for surfels")
"""
    assert interrupted_python(code, delay_s=0.05) == ("no map\nwithin the search for surfels\n", 0)


def test_ctrl_c_ends_a_long_call_of_the_core():
    """An interrupted call leaves most of its work undone. Work is counted in seconds of this thread on a processor."""
    # Rays through thousands of cells with a plane each that none of them meets.
    cells = (np.stack(np.meshgrid(*[np.arange(-20, 20)] * 3), -1).reshape(-1, 3) * 0.4 + 0.2).astype(
        np.float32
    )
    keys = np.sort(_core.cell_keys(cells, 0.4, 1))
    planes = np.full((len(keys), 8), 100, np.float32)
    planes[:, 3:] = [1, 0, 0, 0.01, np.inf]
    directions = np.random.default_rng(0).normal(size=(100_000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    surfels = _core.SurfelMap(keys, planes, 0.4)

    def call(directions):
        interrupted, started_s = False, time.thread_time()
        try:
            surfels.first_crossings(
                5 * directions, directions, np.full(len(directions), 10, np.float32), 0.1, 0.01, 0.1, 2.0, 1
            )
        except KeyboardInterrupt:  # perhaps only where the call had ended: the work tells
            interrupted = True
        return time.thread_time() - started_s, interrupted

    # The timer counts in steps of some milliseconds: the work has to be long beside these on any machine.
    while (whole_s := call(directions)[0]) < 0.4:
        directions = np.concatenate([directions, directions])
    before = signal.signal(signal.SIGVTALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.1 * whole_s)
        work_s, interrupted = call(directions)
    finally:
        signal.signal(signal.SIGVTALRM, before)
    assert interrupted
    assert work_s < 0.6 * whole_s


def test_ctrl_c_ends_a_mesh():
    code = """
import radarsdf
from tests.conftest import ground_and_wall
scene = ground_and_wall()
config = radarsdf.FitConfig(training={"sdf_iterations": 5})
radar_map = radarsdf.fit(scene.points, scene.poses, config=config, progress=False)
# The first mesh imports. Ctrl-C within an import's exec() of a string, as of a dataclass, is remembered by CPython:
# the process then ends as if by the signal, although the exception was caught.
radar_map.mesh(0.2)
print("ready", flush=True)
try:
    while True:
        radar_map.mesh(0.03)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""
    assert interrupted_python(code, delay_s=0.3) == ("", 0)


def test_ctrl_c_during_the_import_of_trimesh_is_not_taken_for_a_missing_part():
    code = """
import importlib.abc, os, signal, sys, torch
class Press(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == part and not presses:
            presses.append(name)
            signal.raise_signal(signal.SIGINT)
presses = []
import radarsdf
for part in ("networkx", "scipy", "shapely"):
    assert "trimesh" not in sys.modules and part not in sys.modules
    if (child := os.fork()) == 0:  # PyTorch, which takes seconds, is imported for all three
        sys.meta_path.insert(0, Press())
        try:
            import radarsdf.map.mesh
        except KeyboardInterrupt:
            print("stopped", *presses, flush=True)
        import radarsdf.map.mesh  # and now it is whole
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        os._exit(17)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 17
"""
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", code]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout == "stopped networkx\nstopped scipy\nstopped shapely\n"


def test_the_command_saves_the_map_so_far_and_says_so_in_one_line(tmp_path):
    scene = ground_and_wall()
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    code = (
        ANNOUNCED.format(steps=5)
        + """
import sys
from radarsdf.cli import main
sys.exit(main())
"""
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "fit", str(tmp_path / "scans.npz"), "-o", str(tmp_path / "map.safetensors")]
        + ["--quiet", "--set", "training={'sdf_iterations': 1000000}", "--checkpoint", str(tmp_path / "state")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=HUNG_S)
    assert process.returncode == 130
    assert said == f"error: interrupted while training; the map so far is in {tmp_path}/map.safetensors\n"
    radar_map = radarsdf.load(tmp_path / "map.safetensors")
    assert 0 < radar_map.report["iterations_done"]["sdf"] < 1_000_000
    assert (tmp_path / "state").exists()


def test_a_deferred_interrupt_is_remembered_and_a_second_is_not():
    usual = signal.getsignal(signal.SIGINT)
    with deferred_interrupts() as pressed:
        assert not pressed()
        signal.raise_signal(signal.SIGINT)
        assert pressed()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is usual


def test_someone_elses_handler_stays():
    seen = []
    usual = signal.signal(signal.SIGINT, lambda *_: seen.append(1))
    try:
        with deferred_interrupts() as pressed:
            signal.raise_signal(signal.SIGINT)
            assert not pressed()
    finally:
        signal.signal(signal.SIGINT, usual)
    assert seen == [1]


@pytest.fixture
def poisoned(monkeypatch):
    """Makes the n-th step see one gradient that is not a number."""
    step = Adam.step

    def at(n):
        count = 0

        def poisoned_step(adam, gradients):
            nonlocal count
            count += 1
            if count == n:
                gradients[0].view(-1)[0] = math.nan
            step(adam, gradients)

        monkeypatch.setattr(Adam, "step", poisoned_step)

    return at


def test_a_gradient_that_is_not_finite_never_reaches_the_map(scene, poisoned):
    poisoned(230)
    config = FitConfig(training={"sdf_iterations": 400, "batch_size": 512})
    with pytest.raises(
        Diverged, match=r"not finite at iteration \d+ of 400 of the sdf stage|loss is nan"
    ) as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    radar_map = caught.value.radar_map
    assert all(value.isfinite().all() for value in radar_map.field.state_dict().values())
    assert 229 <= radar_map.report["iterations_done"]["sdf"] <= 300
    assert (
        radar_map.sdf(scene.poses[:, :3, 3], extrapolate=True) > 0
    ).all()  # as learnt before, not as at the start


def test_the_last_step_is_looked_at_too(scene, poisoned):
    poisoned(20)
    with pytest.raises(Diverged, match="iteration 19 of 20"):
        radarsdf.fit(
            scene.points, scene.poses, config=FitConfig(training={"sdf_iterations": 20, "batch_size": 512})
        )


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("name", ["sdf", "intensity"])
def test_the_message_names_the_loss_the_stage_and_the_iteration(scene, monkeypatch, name, joint):
    calls = 0
    stage, of = ("sdf", 10) if joint or name == "sdf" else ("intensity", 20)
    eighth = 8 if stage == "sdf" else 10 + 8

    def failing(of_stage):
        def gradients(backend, batch, meanwhile):
            nonlocal calls
            calls += 1
            found, result = of_stage(backend, batch, meanwhile)
            if calls == eighth:
                found.losses[name] *= math.inf
            return found, result

        return gradients

    for method in ("sdf", "joint", "intensity"):
        monkeypatch.setattr(CoreGradients, method, failing(getattr(CoreGradients, method)))
    config = FitConfig(
        num_threads=1,
        training={"sdf_iterations": 10, "intensity_iterations": 20, "batch_size": 512, "joint": joint},
    )
    expected = f"the {name} loss is inf at iteration 7 of {of} of the {stage} stage"
    with pytest.raises(Diverged, match=expected) as caught:
        radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config)
    assert isinstance(caught.value, FloatingPointError)
    assert np.isfinite(caught.value.radar_map.sdf(np.zeros((1, 3)), extrapolate=True)).all()


def test_the_map_after_a_divergence_has_no_gradients_and_threads_are_restored(scene):
    threads = torch.get_num_threads()
    config = FitConfig(training={"learning_rate": 1e30, "sdf_iterations": 50, "cosine_schedule": False})
    with pytest.raises(Diverged) as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    assert not any(p.requires_grad for p in caught.value.radar_map.field.parameters())
    assert torch.get_num_threads() == threads


def test_an_interrupted_fit_is_a_keyboard_interrupt_even_where_nobody_defers(scene, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("radarsdf.fitting.training.Training.run", interrupt)
    config = FitConfig().override(training={"sdf_iterations": 1})
    with pytest.raises(Interrupted, match="while training") as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    assert caught.value.radar_map.report["iterations_done"] == {"sdf": 0, "intensity": 0}
    monkeypatch.setattr("radarsdf.fitting.fit.prepare", interrupt)
    with pytest.raises(Interrupted, match="before the training") as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    assert caught.value.radar_map is None
