# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page as a whole: what is on it, and that it needs and executes nothing else."""

from __future__ import annotations

import dataclasses
import re
import subprocess

import numpy as np
import pytest
import radarsdf
from radarsdf.evaluation import intensity_metrics, surface_metrics
from radarsdf.io import Scans
from radarsdf.map.colors import NEUTRAL
from radarsdf.report.surface import colored

from ..warm_python import warm_python
from .conftest import HOSTILE
from .reading import Page

SECTIONS = [
    "conclusion", "check", "surface", "errors", "uncertainty", "intensity", "training", "skipped", "configuration",
    "versions",
]  # fmt: skip


def test_every_section_is_there_with_a_link_to_it(written):
    _, page = written
    assert [found["id"] for found in page.all("section")] == SECTIONS
    assert [found["href"] for found in page.all("a")] == [f"#{name}" for name in SECTIONS]
    assert all(len(page.sections[name]) > 50 for name in SECTIONS)


def test_it_names_no_other_machine_and_a_browser_may_load_nothing(written):
    path, page = written
    assert len(page.frames) == 1
    assert re.findall(rb"(?:https?|wss?):/+", path.read_bytes()) == []
    assert all(address.startswith(("data:", "#")) for address in page.addresses())
    (policy,) = [found["content"] for found in page.all("meta") if "http-equiv" in found]
    sources = {word for rule in policy.split("; ") for word in rule.split()[1:]}
    assert sources <= {"'none'", "'unsafe-inline'", "'unsafe-eval'", "'wasm-unsafe-eval'", "data:", "blob:"}
    assert policy.startswith("default-src 'none'")


def test_nothing_that_is_read_is_executed(written):
    path, page = written
    assert page.all("script") == []  # only the frame has some, which has no access to this page
    assert page.all("iframe")[0]["sandbox"] == "allow-scripts"
    assert page.sections["check"].count("made_up") == 1
    assert all(found == {} for found in page.all("b"))
    assert len(page.all("b")) == len(page.all("li"))  # the names in lists, and not the text of the finding
    assert page.all("i") == [found for found in page.all("i") if "style" in found]
    assert "<b>1 of 2</b> Mend <i>it</i>." in page.sections["check"]
    title = re.search(r"<title>(.*?)</title>", path.read_text("utf-8"))[1]
    assert title == "&lt;script&gt;alert(&quot;$title&quot;)&lt;/script&gt;&#x27;&amp;amp;.safetensors"
    assert HOSTILE in page.sections[""]


def test_pictures_are_said_in_words(written):
    _, page = written
    assert len(page.all("img")) == 12
    assert all(len(found["alt"]) > 20 for found in page.all("img"))
    assert page.all("iframe")[0]["title"]
    assert page.all("html") == [{"lang": "en"}]
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all("meta")


def verdicts(page):
    """The sentences of the conclusion by what they are about."""
    text = re.sub(r"\s+", " ", page.sections["conclusion"].replace("\xa0", " "))
    names = ("Radar noise", "Scans and poses", "Surface", "Uncertainty", "Intensity", "Next")
    found = re.split(f"(?:good|warning|error|note) ({'|'.join(names)})", text)[1:]
    return dict(zip(found[::2], found[1::2], strict=True))


def test_the_conclusion_says_in_words_what_the_figures_are(written, subject):
    _, page = written
    said, report = verdicts(page), subject.radar_map.report
    assert list(said) == ["Radar noise", "Scans and poses", "Surface", "Uncertainty", "Intensity", "Next"]
    assert f"{report['noise']['range_m']:.3f} m along the beam" in said["Radar noise"]
    assert "as expected" in said["Radar noise"]
    assert "The check found made_up." in said["Scans and poses"]
    metrics = surface_metrics(subject.mesh, subject.scans.ground_truth, samples=20_000)
    assert f"F-score is {100 * metrics['f_score_all']:.1f} %" in said["Surface"]
    share = re.search(r"([\d.]+)\s% of them are within one standard error", page.sections["uncertainty"])[1]
    assert (
        f"{share} % of its errors are within one standard error, where 68 % are expected"
        in said["Uncertainty"]
    )
    mae, neighbours = re.findall(r"(?:This map|Nearest neighbours) ([\d.]+)", page.sections["intensity"])
    assert f"mean error is {mae} sensor units, beside {neighbours} of the nearest" in said["Intensity"]
    assert "on scans that the fit left out" in said["Intensity"]
    assert "Mend <i>it</i>. Then fit again." in said["Next"]


def test_the_conclusion_follows_the_figures(subject, tmp_path):
    noise = {"range_m": 0.4, "azimuth_rad": 0.001, "elevation_rad": 0.001}
    contents = subject.radar_map._contents
    noisy = radarsdf.RadarMap(dataclasses.replace(contents, report=contents.report | {"noise": noise}))
    scans = Scans(subject.scans.points, subject.scans.poses, subject.scans.intensities)
    page = other(subject, tmp_path / "noisy.html", radar_map=noisy, scans=scans, findings=[], held_out=None)
    said = verdicts(page)
    assert "more than expected" in said["Radar noise"]
    assert "The scans agree" in said["Scans and poses"]
    assert "--holdout 10" in said["Next"]
    assert "may have been trained on" in said["Intensity"]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("lidar", "lidar point"),
        ("simulated", "point of the simulated truth"),
        ("given", "point of the given truth"),
    ],
)
def test_the_truth_has_the_name_of_its_kind(subject, kind, words):
    from radarsdf.report.truth import truth_section, uncertainty_section  # noqa: PLC0415

    scans = subject.scans.select(np.arange(len(subject.scans)))
    scans.truth_kind = kind
    same = dataclasses.replace(subject, scans=scans, voxel_size_m=0.5)
    for section, *_ in (truth_section(same), uncertainty_section(same)):
        text = re.sub("<img[^>]*>", "", "".join(section.body))
        assert words in text
        assert ("lidar" in text) == (kind == "lidar")


def test_errors_are_those_of_the_evaluation(written, subject):
    _, page = written
    metrics = surface_metrics(subject.mesh, subject.scans.ground_truth, samples=20_000)
    assert f"F-score, nothing discarded {100 * metrics['f_score_all']:.1f}\xa0%" in page.sections["errors"]
    assert f"Completion {100 * metrics['completion_ratio']:.1f}\xa0%" in page.sections["errors"]


def test_intensities_are_compared_on_the_scans_that_were_held_out(written, subject, scene):
    _, page = written
    sensor = scene.poses[0, :3, 3]
    x = scene.points[0] @ scene.poses[0, :3, :3].T + sensor
    metrics = intensity_metrics(subject.radar_map.intensity(x, sensor), scene.intensities[0])
    text = page.sections["intensity"]
    assert f"This map {metrics['mae']:.2f} {metrics['medae']:.2f}" in text
    assert "all 1,500 returns of the 1 scan that the fit left out" in text
    assert "Nearest neighbours" in text


def test_what_was_skipped_checked_and_set(written, subject):
    _, page = written
    report = subject.radar_map.report
    for words in report["skipped"]:
        assert words in page.sections["skipped"]
    assert "warning made_up" in re.sub(r"\s+", " ", page.sections["check"])
    assert "learning_rate = " in page.sections["configuration"]
    assert radarsdf._core.__version__ in page.sections["versions"]
    assert f"{report['returns']:,}" in page.sections["training"]


def other(subject, path, **changes):
    from radarsdf.report.writing import write_report  # noqa: PLC0415

    write_report(path, dataclasses.replace(subject, **changes))
    return Page(path.read_text("utf-8"))


def test_a_map_alone(subject, tmp_path):
    page = other(subject, tmp_path / "alone.html", scans=None, held_out=None, findings=None)
    assert [found["id"] for found in page.all("section")] == SECTIONS
    for name in ("conclusion", "errors", "intensity", "check"):
        assert "without scans" in page.sections[name]
    said = verdicts(page)
    assert "not checked" in said["Scans and poses"]
    assert "was not measured" in said["Surface"]
    assert "Give the scans" in said["Next"]


def test_scans_that_the_fit_may_have_seen_are_said_to_be(subject, tmp_path):
    page = other(subject, tmp_path / "seen.html", held_out=None)
    assert "may have been trained on them" in page.sections["intensity"]
    assert "left out" not in page.sections["intensity"].split("--holdout")[0]
    assert "Nearest neighbours" not in page.sections["intensity"]


def test_without_intensities_and_without_training(subject, scene, tmp_path):
    quick = radarsdf.fit(scene.points, scene.poses, config=radarsdf.FitConfig.quick(), progress=False)
    page = other(subject, tmp_path / "quick.html", radar_map=quick)
    assert "fitted without intensities" in page.sections["intensity"]
    assert "No losses" in page.sections["training"]
    assert "in grey" in page.sections["surface"]
    assert "sdf_iterations 0" in page.sections["configuration"]


def test_where_there_is_no_surface(subject, tmp_path):
    page = other(subject, tmp_path / "nothing.html", box=[[900, 900, 900], [901, 901, 901]])
    assert "no surface here" in page.sections["surface"]
    assert page.frames == []
    assert [found["id"] for found in page.all("section")] == SECTIONS


def test_a_large_mesh_is_shown_thinned_and_measured_whole(subject, tmp_path, monkeypatch):
    faces, vertices = len(subject.mesh.faces), len(subject.mesh.vertices)
    monkeypatch.setattr("radarsdf.report.subject.MOST_VERTICES", vertices // 3)
    large = dataclasses.replace(subject)
    assert len(large.shown[0].faces) < faces / 2
    assert len(large.mesh.faces) == faces
    page = other(subject, tmp_path / "large.html", scans=None, held_out=None)
    assert f"{faces:,}: too many" in page.sections["surface"]
    assert f"{len(large.shown[0].faces):,} triangles" in page.sections["surface"]


def test_an_old_file_stays_if_the_new_one_cannot_be_made(subject, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")
    with monkeypatch.context() as patch:
        patch.setattr("radarsdf.report.page.page", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            other(subject, path, scans=None, held_out=None)
    monkeypatch.setattr("radarsdf.io.files.os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(OSError, match="full"):
        other(subject, path, scans=None, held_out=None)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("report.html", "old")]


def test_100000_vertices_stay_under_5_mb(written):
    from radarsdf.report.scene import scene_page  # noqa: PLC0415
    from radarsdf.view.framing import Look  # noqa: PLC0415

    rng = np.random.default_rng(0)
    side = 317
    x, y = (a.ravel() * 0.1 for a in np.mgrid[:side, :side])
    vertices = np.stack([x, y, np.sin(x) + rng.normal(0, 0.02, x.size)], axis=1)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    corners = np.stack([first, first + 1, first + side, first + side + 1], axis=1)
    faces = np.concatenate([corners[:, [0, 2, 1]], corners[:, [1, 2, 3]]]).astype(np.int32)
    colors = rng.integers(0, 256, (len(vertices), 3), np.uint8)  # noise: no map is harder to compress
    assert len(vertices) > 100_000
    eye = np.array([10.0, -20.0, 20.0])
    page = scene_page(vertices, faces, colors, vertices[:100], Look(eye, np.zeros(3)))
    rest = written[0].stat().st_size - len(written[1].all("iframe")[0]["srcdoc"])
    assert rest < 700_000  # with small pictures, of which there are five; large ones have up to 150 kB each
    assert len(page) + rest + 5 * 150_000 < 5_000_000


def test_no_setting_of_matplotlib_changes_and_pyplot_is_not_needed():
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    code = """
import sys, matplotlib, numpy as np
def settings():  # to read the backend would choose one, and import pyplot
    return {name: str(matplotlib.rcParams[name]) for name in matplotlib.rcParams if name != "backend"}
before = settings()
from radarsdf.report import plots
values = np.linspace(0, 1, 100)
for data in (
    plots.histogram(values, label="x", most=1.0),
    plots.measured_predicted(values, values, "dB"),
    plots.by_bins(np.linspace(0, 1, 3), values, values, values, label="x", unit="dB"),
    plots.by_bins(np.linspace(0, 1, 3), values[:5], values[:5], values[:5], label="x", unit="dB"),
):
    assert data.startswith(b"\\x89PNG") and b"http" not in data
assert settings() == before and "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([*warm_python(), "-c", code], check=True, timeout=120)


def test_a_legend_has_the_colours_of_the_surface():
    values = np.linspace(3.0, 7.0, 9)
    colors, bar = colored(np.append(values, np.nan), "height, m", (3.0, 7.0))
    assert re.findall(r"rgb\((\d+) (\d+) (\d+)\)", bar) == [
        tuple(map(str, row)) for row in colors[:-1].tolist()
    ]
    assert re.findall(r"<span>(.*?)</span>", bar) == ["3", "7", "height, m"]
    assert tuple(colors[-1]) == NEUTRAL
    assert colored(np.full(3, np.nan), "height, m")[1] == ""
