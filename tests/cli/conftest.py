"""A file of scans and a file of a map, made once for all commands."""

from functools import partial

import pytest
from radarsdf.evaluation import surface_metrics
from radarsdf.io.npz import write_scans
from radarsdf.render import picture

from ..conftest import draw_small, with_truth
from .calls import FAST, call


@pytest.fixture(scope="session")
def scans_file(scene, tmp_path_factory):
    """Six scans of a plane and a wall, with lidar points on the plane."""
    path = tmp_path_factory.mktemp("scans") / "scans.npz"
    write_scans(path, with_truth(scene))
    return path


@pytest.fixture(scope="session")
def map_file(scans_file, tmp_path_factory):
    """The map of these scans, except the held-out scans 0 and 3."""
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    assert call("fit", scans_file, "-o", path, "--holdout", 3, *FAST) == 0
    return path


@pytest.fixture(autouse=True)
def little_work(monkeypatch):
    """Fewer pixels and samples, which take most of the time of pictures and of the demo."""

    def few_samples(mesh, truth, samples, **options):
        return surface_metrics(mesh, truth, samples=min(samples, 20_000), **options)

    monkeypatch.setattr(picture, "save_picture", partial(picture.save_picture, width=160, height=100))
    monkeypatch.setattr("radarsdf.evaluation.surface_metrics", few_samples)


@pytest.fixture
def small_pictures(monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    draw_small(monkeypatch)
