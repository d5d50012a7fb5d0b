"""Forked and spawned processes, pickles, many threads, other platforms: correct results, and never a deadlock."""

import copy
import dataclasses
import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.io.files import write_whole

QUICK = FitConfig(training={"sdf_iterations": 20, "intensity_iterations": 20, "batch_size": 1024})
X = np.random.default_rng(0).uniform([8, -5, -1], [20, 5, 3], (30_000, 3))


def everywhere(radar_map, x=X):
    """Signed distances, including unobserved places: NaN would hide differences."""
    return radar_map.sdf(x, extrapolate=True)


FORK = """
import os, signal, sys, threading
import numpy as np, torch, radarsdf
from tests.conftest import ground_and_wall
from tests.test_processes import QUICK, X, everywhere
torch.set_num_threads(2)
scene = ground_and_wall()
def fitted(threads=0):
    config = QUICK.override(num_threads=threads)
    return radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
radar_map = fitted()
sdf, mesh, product = everywhere(radar_map), radar_map.mesh(0.2), torch.ones(700, 700) @ torch.ones(700, 700)
"""
CHILD = """
child = os.fork()
if child == 0:
    signal.alarm(40)  # instead of waiting for ever
    assert np.array_equal(everywhere(radar_map), sdf)
    assert np.array_equal(radar_map.mesh(0.2).faces, mesh.faces)
    assert torch.equal(torch.ones(700, 700) @ torch.ones(700, 700), product)
    assert torch.get_num_threads() == 1
    again = fitted(threads=2)  # as many as the parent had: the same bits
    assert np.array_equal(everywhere(again), sdf)
    os._exit(17)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 17
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_queries_and_fits_like_its_parent():
    subprocess.run([sys.executable, "-c", FORK + CHILD], check=True, timeout=100)


def answers(radar_map, x):
    intensities = radar_map.intensity(x, np.zeros(3), extrapolate=True)
    return everywhere(radar_map, x), radar_map.confidence(x), intensities


def test_a_map_is_usable_in_spawned_workers(radar_map):
    pieces = np.array_split(X[:2000], 4)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(answers, [radar_map] * 4, pieces))
    for there, here in zip(zip(*found, strict=True), answers(radar_map, X[:2000]), strict=True):
        np.testing.assert_array_equal(np.concatenate(there), here)


def test_pickles_and_copies_are_the_same_map(radar_map):
    without = radarsdf.fit([X], np.eye(4)[None], config=QUICK, progress=False)
    for original in (radar_map, without):
        for other in (pickle.loads(pickle.dumps(original)), copy.deepcopy(original)):
            np.testing.assert_array_equal(everywhere(other), everywhere(original))
            assert (other.config, other.report) == (original.config, original.report)
            assert other.has_intensity == original.has_intensity
            for name, column in dataclasses.asdict(original.evidence).items():
                np.testing.assert_array_equal(getattr(other.evidence, name), column)
            assert other.clutter_ratio == original.clutter_ratio
            assert other.origin.tolist() == original.origin.tolist()


def test_concurrent_queries_change_no_bit(radar_map):
    threads_before = torch.get_num_threads()
    wrong = []

    def found():
        mesh = radar_map.mesh(0.2)
        return everywhere(radar_map), radar_map.gradient(X, extrapolate=True), mesh.vertices

    expected = found()

    def work():
        for _ in range(3):
            wrong.extend([1 for a, b in zip(found(), expected, strict=True) if not np.array_equal(a, b)])

    threads = [threading.Thread(target=work) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert torch.get_num_threads() == threads_before


@pytest.mark.parametrize("progress", [None, True])
def test_a_service_without_standard_error(scene, monkeypatch, progress):
    monkeypatch.setattr(sys, "stderr", None)
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=progress)
    radar_map.mesh(0.4, progress=progress)


# Modules and functions of Python that only POSIX has.
MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios")
FUNCTIONS = ("fork", "register_at_fork", "sched_getaffinity", "getuid", "statvfs")
SIGNALS = ("SIGKILL", "SIGHUP", "SIGALRM", "setitimer", "pthread_sigmask")


def test_imports_and_a_fit_work_without_posix_features():
    code = f"""
import importlib, os, pkgutil, signal, sys
import numpy, pydantic, scipy, torch, trimesh  # which may use what they find
for name in {MODULES}:
    sys.modules[name] = None
for module, names in ((os, {FUNCTIONS}), (signal, {SIGNALS})):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
import radarsdf
extras = ("radarsdf.view", "radarsdf.report", "radarsdf.__main__")
for module in pkgutil.walk_packages(radarsdf.__path__, "radarsdf."):
    if not module.name.startswith(extras):
        importlib.import_module(module.name)
scans = radarsdf.simulate.wall(frames=2)
radar_map = radarsdf.fit(scans.points, scans.poses, config=radarsdf.FitConfig.quick())
assert len(radar_map.mesh(0.2).faces)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_file_open_in_another_program_is_kept(tmp_path, monkeypatch):
    """Windows refuses to replace it."""
    path = tmp_path / "map.safetensors"
    path.write_bytes(b"old")

    def refuse(self, target):
        raise PermissionError(13, "The process cannot access the file", str(self), 32, str(target))

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(PermissionError, match=r"map\.safetensors"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["map.safetensors"]


RECORDED = """
import threading
import torch
from radarsdf import threads

calls = []

def recorded(name):
    function = getattr(torch, name)
    def record(*arguments, **keywords):
        dtype = arguments[0].dtype if isinstance(arguments[0], torch.Tensor) else keywords["dtype"]
        calls.append((name, dtype, threading.current_thread() is threading.main_thread()))
        return function(*arguments, **keywords)
    setattr(torch, name, record)

names = [*threads._TRANSCENDENTAL, "randn"]
for name in names:
    recorded(name)
everything = {(name, dtype, True) for name in names for dtype in (torch.float32, torch.float64)}
for _ in range(2):
    with threads.ThreadPool(2) as pool:
        assert all(pool.map(lambda _: set(calls) == everything, range(8)))
assert len(calls) == len(everything)
"""


def test_functions_are_initialised_once_before_first_use():
    subprocess.run([sys.executable, "-c", RECORDED], check=True)
