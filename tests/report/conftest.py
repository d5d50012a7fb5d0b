"""A report of the small scene, with held-out scans and ground truth, written once."""

import numpy as np
import pytest
import radarsdf

from ..conftest import draw_small, with_truth
from .reading import Page

HOSTILE = """<script>alert("{{ title }}")</script>'&amp;.safetensors"""


@pytest.fixture(scope="session")
def subject(scene, radar_map):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report.writing import Subject  # noqa: PLC0415

    scans = with_truth(scene)
    train, test = scans.select(np.arange(1, 6)), scans.select(np.arange(1))
    findings = [radarsdf.Finding("made_up", "warning", "<b>1 of 2</b>", "Repair <i>it</i>.")]
    return Subject(radar_map, HOSTILE, train, test, findings, voxel_size_m=0.4, progress=False)


@pytest.fixture(scope="session", autouse=True)
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        draw_small(patch)
        yield


@pytest.fixture(scope="session")
def written(subject, tmp_path_factory):
    """Path of the report, and its page."""
    from radarsdf.report.writing import write_report  # noqa: PLC0415

    path = tmp_path_factory.mktemp("report") / "report.html"
    assert write_report(path, subject) == path.stat().st_size
    return path, Page(path.read_text("utf-8"))
