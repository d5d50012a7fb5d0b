"""The report of a map: all sections have figures, and the page neither loads nor executes its contents."""

import dataclasses
import re

import numpy as np
import pytest
import radarsdf
from radarsdf.changes.changes import (
    APPEARED,
    COLORS,
    MOVED,
    NAMES,
    REFLECTANCE_CHANGED,
    SAME,
    ChangedSurface,
    Changes,
)
from radarsdf.evaluation import intensity_metrics, surface_metrics
from radarsdf.io import Scans
from radarsdf.view.pages import centre_of
from scipy.spatial import cKDTree

from tests.view.page import drawn, open_page, why_no_browser

from .conftest import HOSTILE
from .reading import Page

SECTIONS = [
    "conclusion", "check", "surface", "errors", "uncertainty", "intensity", "training", "skipped", "configuration",
]  # fmt: skip
POSES = {
    "verdict": "Poses <b>are</b> better.", "improved": True, "step_m": 0.05, "step_rad": 0.01, "scans": [0, 1, 2],
    "before": [[0.0, 0, 0], [1, 1, 0], [2, 2, 0]], "after": [[0.0, 0, 0], [1, 0, 0], [2, 0, 1]],
    "sigma_m": [0.02, 0.0, 0.02], "sigma_rad": [0.01, 0.0, 0.01],
}  # fmt: skip


def write(path, subject, report=None, **changes):
    """The page of a subject with changed fields, some of them of the report of its map."""
    from radarsdf.report.writing import write_report  # noqa: PLC0415

    if report is not None:
        contents = subject.radar_map._contents
        report = contents.report | report
        changes["radar_map"] = radarsdf.RadarMap(dataclasses.replace(contents, report=report))
    write_report(path, dataclasses.replace(subject, **changes))
    return Page(path.read_text("utf-8"))


def marks(page):
    """Marks of the conclusion by subject."""
    names = "Sensor noise|Scans and poses|Poses|Surface|Uncertainty|Intensity"
    found = re.findall(f"(good|warning|error|note) ({names}) ", page.sections["conclusion"])
    return {name: mark for mark, name in found}


def test_sections_links_and_pictures(written):
    _, page = written
    assert [found["id"] for found in page.all("section")] == SECTIONS
    assert [found["href"] for found in page.all("a")] == [f"#{name}" for name in SECTIONS]
    assert all(len(page.sections[name]) > 50 for name in SECTIONS)
    assert len(page.all("img")) == 6
    assert all(len(found["alt"]) > 20 for found in page.all("img"))
    assert page.all("iframe")[0]["title"]


def test_the_page_loads_nothing_and_executes_nothing_that_it_reads(written):
    path, page = written
    assert re.findall(rb"(?:https?|wss?):/+", path.read_bytes()) == []
    assert all(address.startswith(("data:", "#")) for address in page.addresses())
    (policy,) = [found["content"] for found in page.all("meta") if "http-equiv" in found]
    sources = {word for rule in policy.split("; ") for word in rule.split()[1:]}
    assert sources <= {"'none'", "'unsafe-inline'", "'unsafe-eval'", "'wasm-unsafe-eval'", "data:", "blob:"}
    assert policy.startswith("default-src 'none'")
    assert page.all("script") == []  # only in the frame, which cannot access this page
    assert page.all("iframe")[0]["sandbox"] == "allow-scripts"
    assert "<b>1 of 2</b> Repair <i>it</i>." in page.sections["check"]
    assert len(page.all("b")) == len(page.all("li"))
    assert page.sections[""].count(HOSTILE) == 2  # title and heading


def test_figures_equal_the_evaluation(written, subject, scene):
    _, page = written
    metrics = surface_metrics(subject.mesh, subject.scans.ground_truth, samples=20_000)
    for name, text in page.sections.items():
        page.sections[name] = text.replace("\xa0", " ")
    f_score = f"{100 * metrics['f_score_all']:.1f} %"
    assert f"{100 * metrics['completion_ratio']:.1f} %" in page.sections["errors"]
    assert f_score in page.sections["errors"]
    share = re.search(r"([\d.]+ %) of them are within one standard error", page.sections["uncertainty"])[1]
    assert f"{share} of the errors" in page.sections["conclusion"]
    # Errors along the normal from the nearest point of the ground truth within 0.4 m.
    truth, vertices = subject.scans.ground_truth, np.asarray(subject.mesh.vertices)
    distance_m, nearest = cKDTree(truth).query(vertices)
    error_m = np.einsum("ni,ni->n", truth[nearest] - vertices, subject.mesh.vertex_normals)
    sigma_m, confidence = (subject.mesh.vertex_attributes[name] for name in ("uncertainty_m", "confidence"))
    known = (distance_m <= 0.4) & np.isfinite(sigma_m)
    z = np.abs(error_m / sigma_m)[known]
    assert share == f"{100 * np.mean(z <= 0.99446):.1f} %"
    assert f"{100 * np.mean(z <= 1.95996):.1f} % within the 95 % interval" in page.sections["uncertainty"]
    assert f"for the {100 * known.mean():.1f} % of the surface within 0.4 m" in page.sections["uncertainty"]
    for values, digits in ((sigma_m, 3), (confidence, 2)):
        shown = " ".join(f"{value:.{digits}f}" for value in np.nanpercentile(values, [10, 50, 90]))
        assert shown in page.sections["uncertainty"]
    sensor = scene.poses[0, :3, 3]
    x = scene.points[0] @ scene.poses[0, :3, :3].T + sensor
    metrics = intensity_metrics(subject.radar_map.intensity(x, sensor), scene.intensities[0])
    assert f"This map {metrics['mae']:.2f} {metrics['medae']:.2f}" in page.sections["intensity"]
    off = np.abs(scene.intensities[0] - np.median(scene.intensities[0]))
    assert f"{off.mean():.2f} {np.median(off):.2f}" in page.sections["intensity"]
    report = subject.radar_map.report
    assert f"{report['noise']['range_m']:.3f} m" in page.sections["conclusion"]
    for name in ("returns", "leaf_cells", "vertices"):
        assert f" {report[name]:,} " in page.sections["training"]
    fit_s = sum(report[name] for name in report if name.endswith("_s") and name != "skipped_s")
    assert f"Fit {fit_s:.1f} s" in page.sections["conclusion"] + page.sections[""]
    assert all(words in page.sections["skipped"] for words in report["skipped"])


def test_the_conclusion_follows_the_figures(written, subject, tmp_path):
    assert marks(written[1])["Scans and poses"] == "warning"
    assert marks(written[1])["Sensor noise"] == "good"
    noise = {"range_m": 0.4, "azimuth_rad": 0.001, "elevation_rad": 0.001}
    scans = Scans(subject.scans.points, subject.scans.poses, subject.scans.intensities)
    changes = {"scans": scans, "findings": [], "held_out": None}
    page = write(tmp_path / "noisy.html", subject, {"noise": noise, "poses": POSES}, **changes)
    found = marks(page)
    assert (found["Sensor noise"], found["Scans and poses"], found["Poses"]) == ("warning", "good", "good")
    assert "--holdout 10" in page.sections["intensity"]
    assert "trained on" in page.sections["intensity"]
    poses = page.sections["poses"].replace("\xa0", " ")
    for figure in (POSES["verdict"], "2.4 m", "1.414 m", "2.236 m", "0.020 m, 0.57°"):
        assert figure in poses


def test_a_map_alone_without_surface_intensities_or_training(subject, scene, tmp_path):
    page = write(tmp_path / "alone.html", subject, scans=None, held_out=None, findings=None)
    assert [found["id"] for found in page.all("section")] == SECTIONS
    for name in ("conclusion", "errors", "intensity", "check"):
        assert "without scans" in page.sections[name]
    assert {mark for name, mark in marks(page).items() if name != "Sensor noise"} == {"note"}

    quick = radarsdf.fit(scene.points, scene.poses, config=radarsdf.FitConfig.quick(), progress=False)
    nowhere = [[900, 900, 900], [901, 901, 901]]
    page = write(tmp_path / "quick.html", subject, radar_map=quick, box=nowhere)
    assert "without intensities" in page.sections["intensity"]
    assert "no surface here" in page.sections["surface"]
    assert "train False" in page.sections["configuration"]
    assert page.frames == []


def test_a_large_mesh_is_drawn_thinned_and_evaluated_whole(subject, tmp_path, monkeypatch):
    faces, vertices = len(subject.mesh.faces), len(subject.mesh.vertices)
    monkeypatch.setattr("radarsdf.report.writing.MAX_VERTICES", vertices // 3)
    large = dataclasses.replace(subject)
    assert len(large.shown[0].faces) < faces / 2
    page = write(tmp_path / "large.html", subject, scans=None, held_out=None)
    assert f"{len(large.shown[0].faces):,} of {faces:,} triangles" in page.sections["surface"]


def test_ground_truth_and_viewpoint_are_of_the_scans_in_the_box(subject, radar_map):
    scans, corner = subject.scans, subject.scans.ground_truth[0]
    np.testing.assert_array_equal(subject.viewpoint, scans.poses[2, :3, 3])  # the middle one of five
    alone = dataclasses.replace(subject, scans=None)
    np.testing.assert_array_equal(alone.viewpoint, radar_map.origin)
    assert alone.ground_truth is None
    step_m = np.array([0.5, 0.5, 0.0])
    boxed = dataclasses.replace(subject, box=[corner - [0, 0, 1], corner + step_m])  # on its faces is within
    assert len(boxed.ground_truth) == 4
    assert dataclasses.replace(subject, box=[corner + [0, 0, 1], corner + [9, 9, 2]]).ground_truth is None


@pytest.mark.skipif(why_no_browser() is not None, reason=str(why_no_browser()))
def test_a_browser_shows_the_report_offline(written):
    path, _ = written
    with open_page(path.as_uri(), 1200, 700) as page:
        for width in (1200, 380):
            page.tab.set_viewport_size({"width": width, "height": 700})
            page.tab.reload()  # the scene is framed for the width at which it is loaded
            canvas = page.tab.frame_locator("iframe").locator("canvas").first
            # Frames outside of the view are not drawn.
            page.tab.locator("iframe").scroll_into_view_if_needed()
            canvas.wait_for(state="visible")
            page.wait_until(lambda: drawn(page.screenshot_of("iframe")) > 2_000)
            box = canvas.bounding_box()
            assert box["width"] > 0.8 * page.tab.locator("iframe").bounding_box()["width"]

            # The scene fits into its frame: nothing is drawn at its sides and at its bottom.
            seen = page.screenshot_of("iframe")
            for edge in (seen[4:-4, 4:8], seen[4:-4, -8:-4], seen[-8:-4, 4:-4]):
                assert (edge > 235).all()
            for scrolled, seen in ((page.tab, width), (page.tab.frames[1], box["width"])):
                assert scrolled.evaluate("document.documentElement.scrollWidth") <= seen

        assert page.tab.title()
        asked = {name for name in page.requests if not name.startswith(("data:", "blob:", "about:"))}
        assert asked == {path.as_uri()}
        assert page.errors == []


HOSTILE_NAME = "<script>alert(1)</script>.safetensors"


def surface(kinds):
    """A sheet of 2 × 2 m for each kind, side by side."""
    steps = np.linspace(0, 2, 9)
    sheet = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 9, 1], corner[:, None] + [1, 9, 10]])
    count = len(sheet)
    vertices = np.concatenate([sheet + [0, 3.0 * number, 0] for number in range(len(kinds))])
    faces = np.concatenate([faces + count * number for number in range(len(kinds))]).astype(np.int32)
    kind = np.repeat(np.array(kinds, np.int8), count)
    moved = np.where(kind == MOVED, 0.25, np.nan).astype(np.float32)
    change = np.where(kind == REFLECTANCE_CHANGED, 6.5, np.nan).astype(np.float32)
    return ChangedSurface(vertices, faces, kind, np.full(len(kind), 0.9, np.float32), moved, change)


@pytest.mark.parametrize("kinds", [[SAME], [SAME, APPEARED, MOVED, REFLECTANCE_CHANGED]])
def test_each_change_is_named_listed_and_shown(kinds, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report import writing as module  # noqa: PLC0415

    scene, shown = module.scene, []
    monkeypatch.setattr(module, "scene", lambda *mesh: shown.append(mesh) or scene(*mesh))
    areas_m2 = {NAMES[kind]: 4.0 * kinds.count(kind) for kind in (APPEARED, 1, MOVED, REFLECTANCE_CHANGED)}
    report = {
        "alignment": "As <b>given</b>.",
        "areas_m2": areas_m2,
        "compared_m2": 20.0,
        "reflectance": "+0.4",
    }
    changes = Changes(surface([SAME]), surface(kinds), np.eye(4), report)
    regions, path = changes.regions(0.1), tmp_path / "changes.html"
    size = module.write_changes_report(path, changes, ("monday", HOSTILE_NAME), 0.2, regions)
    assert size == path.stat().st_size
    np.testing.assert_allclose(shown[0][0].mean(axis=0), 0, atol=1e-9)  # the page computes in float32
    page = Page(path.read_text("utf-8"))
    assert "As <b>given</b>." in page.sections["conclusion"]
    for region in regions:
        assert region.kind.capitalize() in page.sections["conclusion"]
        size = "{:.1f} × {:.1f} × {:.1f}".format(*(region.box[1] - region.box[0]))
        figures = f"{size} {region.area_m2:.2f} {region.probability:.2f}"
        assert f"{region.words} {centre_of(region)} {figures}" in page.sections["changes"]
    assert len(regions) == len(kinds) - 1
    assert len(page.all("tr")) == (1 + len(regions) if regions else 0)
    assert len(page.all("img")) == 2
    assert len(page.frames) == 1
    styles = [found.get("style", "") for found in page.all("i")]
    assert all("background:rgb({} {} {})".format(*color) in styles for color in COLORS.values())
    assert not page.all("script")
    assert all(address.startswith(("#", "data:")) for address in page.addresses())
