"""A fit stopped by Ctrl-C or by values that are not finite ends promptly and returns its map."""

import math
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import radarsdf
from radarsdf import Diverged, FitConfig, Interrupted, _core
from radarsdf.fitting.steps import Adam
from radarsdf.interrupts import deferred_interrupts, terminable

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
LONG = {"training": {"sdf_iterations": 1_000_000, "batch_size": 512}}
HUNG_S = 300.0
"""A process that has not ended by then never will. No test asks how fast it is: the processor may be busy."""


def interrupted_python(code, delay_s=0.0):
    """Runs code and sends Ctrl-C some time after it prints "ready".

    Returns its output after the line "stopped", and its exit status.
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


# Prints "ready" after a number of steps of the optimisers, of which a joint fit has two.
ANNOUNCED = """
from radarsdf.fitting.steps import Adam
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
    # PyTorch's compiler, which takes a second to import.
    assert not [name for name in sys.modules if name.partition(".")[0] == "sympy" or name == "torch._dynamo"]
    print("a map")
"""
)


def test_ctrl_c_while_training_returns_the_map_without_pytorch_s_compiler():
    code = FIT.format(steps=400, intensities="scene.intensities", config=LONG | {"num_threads": 2})
    assert interrupted_python(code) == ("a map\n", 0)


def test_ctrl_c_ends_a_long_call_of_the_core():
    """An interrupted call skips most of its work, measured as CPU time of this thread."""
    # Rays through thousands of cells with a plane each, without a crossing.
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
        except KeyboardInterrupt:  # perhaps only after the call had ended: CPU time decides
            interrupted = True
        return time.thread_time() - started_s, interrupted

    # The timer has a resolution of some milliseconds: the work must take much longer on any machine.
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


def test_only_the_first_interrupt_is_deferred():
    usual = signal.getsignal(signal.SIGINT)
    with deferred_interrupts() as pressed:
        assert not pressed()
        signal.raise_signal(signal.SIGINT)
        assert pressed()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is usual


def test_sigterm_acts_as_ctrl_c():
    usual = signal.getsignal(signal.SIGTERM)
    with terminable():
        with deferred_interrupts() as pressed:
            signal.raise_signal(signal.SIGTERM)
            assert pressed()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is usual


@pytest.fixture
def poisoned(monkeypatch):
    """Sets one gradient of the n-th step to NaN."""
    step = Adam.step

    def at(n):
        count = 0

        def poisoned_step(adam, gradients, *others):
            nonlocal count
            count += 1
            if count == n:
                gradients[0].view(-1)[0] = math.nan
            step(adam, gradients, *others)

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
    at_sensors = radar_map.sdf(scene.poses[:, :3, 3], extrapolate=True)
    assert (at_sensors > 0).all()  # trained values, not initial ones


def test_an_interrupted_fit_raises_keyboard_interrupt_without_deferral(scene, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("radarsdf.fitting.train.Training.run", interrupt)
    config = FitConfig().override(training={"sdf_iterations": 1})
    with pytest.raises(Interrupted, match="while training") as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    assert caught.value.radar_map.report["iterations_done"] == {"sdf": 0, "intensity": 0}
    monkeypatch.setattr("radarsdf.fitting.fit.static_rays", interrupt)
    with pytest.raises(Interrupted, match="before the training") as caught:
        radarsdf.fit(scene.points, scene.poses, config=config)
    assert caught.value.radar_map is None
