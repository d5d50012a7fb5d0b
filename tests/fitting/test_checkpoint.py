"""Resuming a fit from its checkpoint changes no bit, and other files are rejected."""

import dataclasses
import json
import signal
import subprocess
import sys

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig, Interrupted
from radarsdf.io.tensors import open_tensors, tensor_bytes
from safetensors import safe_open

from ..conftest import ground_and_wall
from ..settings import grouped

# Batches larger than the number of rays, so that the order is drawn repeatedly, and two stages.
QUICK = FitConfig(
    num_threads=2,
    training={
        "sdf_iterations": 30,
        "intensity_iterations": 60,
        "batch_size": 1024,
        "intensity_batch_size": 700,
    },
)


@pytest.fixture(scope="module")
def scene():
    """Few returns: only bits are compared."""
    return ground_and_wall(returns_per_scan=300)


def fitted(scene, path=None, config=QUICK, intensities=True):
    given = scene.intensities if intensities else None
    return radarsdf.fit(scene.points, scene.poses, given, config=config, progress=False, checkpoint=path)


def interrupted_after(iterations, monkeypatch, *arguments, **keywords):
    """Interrupts the loop of a fit after some iterations. Returns the iterations done."""

    class Deferred:
        def __enter__(self):
            self.left = iterations
            return self

        def __exit__(self, *_):
            pass

        def __call__(self):
            self.left -= 1
            return self.left == 0

    with monkeypatch.context() as patch:
        patch.setattr("radarsdf.fitting.train.deferred_interrupts", Deferred)
        with pytest.raises(Interrupted) as caught:
            fitted(*arguments, **keywords)
    return caught.value.radar_map.report["iterations_done"]


def assert_same_bits(one, other):
    for name, value in one.field.state_dict().items():
        assert torch.equal(value, other.field.state_dict()[name]), name
    assert one.report["losses"] == other.report["losses"]
    assert one.report["iterations_done"] == other.report["iterations_done"]
    histories = (
        [(h["iterations"], h["losses"]) for h in m.report["loss_history"].values()] for m in (one, other)
    )
    assert next(histories) == next(histories)


@pytest.mark.parametrize("changes", [{}, {"optimiser": "adam", "num_threads": 1}])
def test_repeated_interruptions_change_no_bit(scene, tmp_path, monkeypatch, changes):
    config = QUICK.override(**grouped(**changes))
    whole = fitted(scene, config=config)
    path = tmp_path / "state"
    for stops in range(1, 4):  # of 60 iterations in all
        done = interrupted_after(17, monkeypatch, scene, path, config)
        assert done == {"sdf": min(17 * stops, 30), "intensity": 17 * stops}
    resumed = fitted(scene, path, config)
    assert_same_bits(whole, resumed)


def test_another_number_of_threads_changes_no_bit(scene, tmp_path, monkeypatch):
    whole = fitted(scene)
    interrupted_after(17, monkeypatch, scene, tmp_path / "state")
    assert_same_bits(whole, fitted(scene, tmp_path / "state", QUICK.override(num_threads=3)))


def test_a_killed_fit_resumes_from_the_last_checkpoint(scene, tmp_path):
    if sys.platform == "win32":
        pytest.skip("kills by signal")
    path = tmp_path / "state"
    code = f"""
import os, signal
import radarsdf.fitting.checkpoint
from tests.conftest import ground_and_wall
from tests.fitting.test_checkpoint import fitted
radarsdf.fitting.checkpoint._EVERY_S = 0.0
radarsdf.fitting.checkpoint._SHARE = 1e9
write, count = radarsdf.fitting.checkpoint.Checkpoint.write, 0
def counted(self, state):
    global count
    count += 1
    write(self, state)
    if count == 37:
        os.kill(os.getpid(), signal.SIGKILL)
radarsdf.fitting.checkpoint.Checkpoint.write = counted
fitted(ground_and_wall(returns_per_scan=300), {str(path)!r})
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    with safe_open(path, "pt") as file:
        assert file.get_tensor("done").tolist() == [30, 37]
    assert_same_bits(fitted(scene), fitted(scene, path))


@pytest.fixture(scope="module")
def state(scene, tmp_path_factory):
    """The bytes of a checkpoint after three iterations."""
    path = tmp_path_factory.mktemp("checkpoint") / "state"
    with pytest.MonkeyPatch.context() as patch:
        interrupted_after(3, patch, scene, path)
    return path.read_bytes()


class TestOtherFiles:
    """One clear ValueError, and the file is kept."""

    @pytest.fixture
    def path(self, state, tmp_path):
        (tmp_path / "state").write_bytes(state)
        return tmp_path / "state"

    @staticmethod
    def refused(scene, path, match, **changes):
        before = path.read_bytes()
        with pytest.raises(ValueError, match=match):
            fitted(scene, path, QUICK.override(**grouped(**changes)))
        assert path.read_bytes() == before

    def test_of_another_configuration(self, scene, path):
        self.refused(
            scene,
            path,
            r"another configuration: seed, training\.learning_rate differ",
            learning_rate=0.5,
            seed=3,
        )

    def test_of_other_scans(self, scene, path):
        poses = scene.poses.copy()
        poses[2, 0, 3] += 0.001
        self.refused(dataclasses.replace(scene, poses=poses), path, "other scans, poses or intensities")
        values = [v.copy() for v in scene.intensities]
        values[1][0] += 1
        self.refused(
            dataclasses.replace(scene, intensities=values), path, "other scans, poses or intensities"
        )

    def test_no_checkpoint_at_all(self, scene, path):
        for content in (b"", b"scans", bytes(100), b"\xff" * 100):
            path.write_bytes(content)
            self.refused(scene, path, "is not a checkpoint of a fit")
        fitted(scene, config=QUICK.override(training={"sdf_iterations": 1, "intensity_iterations": 1})).save(
            path
        )
        self.refused(scene, path, "is not a checkpoint of a fit")

    def test_of_another_version(self, scene, path):
        self.rewrite(path, version="9.9.9")
        self.refused(scene, path, "was written by radarsdf '9.9.9'")

    @staticmethod
    def rewrite(path, tensors=None, **identity):
        with open_tensors(path) as file:
            metadata = file.metadata
            old = {name: file.array(name).clone() for name in file.names}
        metadata["identity"] = json.dumps(json.loads(metadata["identity"]) | identity)
        path.write_bytes(tensor_bytes(old | (tensors or {}), metadata))

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("done", torch.tensor([31, 0])),
            ("done", torch.tensor([1.0, 0.0])),
            ("field.cells.features", torch.zeros(3, 8)),
            ("sampler.next", torch.tensor(2**40)),
            ("sampler.next", torch.tensor(-7)),
            ("backend.generator", torch.full((5056,), 255, dtype=torch.uint8)),
            ("optimiser.sdf.memory.0", None),
            ("optimiser.intensity.adam.mean.0", None),
            ("rows.states", None),
            ("something", torch.zeros(1)),
        ],
    )
    def test_hostile_tensors(self, scene, path, name, value):
        with safe_open(path, "pt") as file:
            assert name == "something" or name in file.keys()  # noqa: SIM118
            value = (
                torch.full_like(file.get_tensor(name), 2**30 if name == "rows.states" else float("inf"))
                if value is None
                else value
            )
        self.rewrite(path, {name: value})
        self.refused(scene, path, "is not a complete checkpoint of this fit")


def test_a_full_disk_is_a_warning_and_the_fit_continues(scene, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("radarsdf.fitting.checkpoint.write_whole", full)
    with pytest.warns(RuntimeWarning, match="no checkpoint: .*No space"):
        radar_map = fitted(scene, tmp_path / "state")
    assert np.isfinite(radar_map.sdf(np.zeros((1, 3)), extrapolate=True)).all()
