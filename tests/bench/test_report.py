# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`BENCHMARK.md` is what the JSON of a run gives, short, and says what is missing. All figures here are made up."""

from __future__ import annotations

import copy
import json
import shutil

import pytest
import trimesh

from bench.growth import __main__ as growth_command
from bench.paper import __main__ as paper_command
from bench.paper.report import ROOT
from bench.peers.interface import Reconstruction
from bench.report import __main__ as command
from bench.report import experiments, pages, results
from bench.report.document import WORD_LIMIT, document
from bench.report.plots import PLOTS

MACHINE = {
    "processor": "Imaginary 3000", "threads": 2, "instruction_set": "made-up", "python": "3.99", "torch": "9.9",
    "compiler": "none", "cores": 2, "memory_gb": 11, "system": "Nowhere",
}  # fmt: skip


def surface_row(method, share, seconds):
    return {
        "scene": "hugin", "method": method, "returns": 1111, "f_score": share, "f_score_all": share - 0.1,
        "outlier_ratio": 0.1, "seconds": seconds, "peak_bytes": 111e6,
    }  # fmt: skip


def curve_row(kind, method, seconds, share, mae=None):
    row = {"scene": "hugin", "kind": kind, "method": method, "repetition": 0, "seconds": seconds}
    return row | {"f_score_all": share, "noise_floor": 1.0} | ({} if mae is None else {"mae": mae})


@pytest.fixture
def made_up():
    return made_up_results()


def made_up_results():
    parts = {
        "surface": [
            surface_row("radarsdf", 0.75, 3.0),
            surface_row("VDBFusion", 0.5, 1.0),
            {"scene": "hugin", "method": "BPA", "returns": 1111, "why_not": "Open3D is on holiday"},
            {"scene": "hugin", "method": "Poisson", "returns": 1111, "why_not": "Open3D is on holiday"},
        ],
        "intensity": [
            {"scene": "hugin", "method": "kNN", "mae": 7.0, "noise_floor": 1.0},
            {"scene": "hugin", "method": "radarsdf", "seed": 0, "mae": 5.0},
            {"scene": "hugin", "method": "radarsdf", "seed": 1, "mae": 6.0},
        ],
        "curve": [
            curve_row("radarsdf", "radarsdf, × 1", 2.0, 0.8),
            curve_row("radarsdf", "radarsdf, × 4", 8.0, 0.9),
            curve_row("radarsdf, intensities", "radarsdf, intensities, × 1", 4.0, 0.8, 5.0),
            curve_row("lever", "mesh.min_detection_rate=0.0", 4.0, 0.7, 5.0),
            curve_row("peer", "VDBFusion", 1.0, 0.4),
        ],
        "growth": [
            {"returns": n, "size_m": 500.0, "intensities": both, "wall_s": n / 1000 + both, "peak_mb": n / 10}
            for n in (1000, 10_000)
            for both in (False, True)
        ],
        "kernels": [
            {"group": "marching cubes, 392,252 triangles", "case": case, "seconds": seconds}
            for case, seconds in (
                ("test_dense[sphere256-1]", 5.0),
                ("test_dense[sphere256-2]", 0.004),
                ("test_vtk_flying_edges[sphere256-STDThread-2]", 0.01),
            )
        ],
        "queries": [{"what": "signed distances", "count": 22, "seconds": 0.33}],
        "real": [
            {"scene": "drive", "method": "SHINE (octree)", "f_score_all": 0.4, "completion_ratio": 0.6},
            {"scene": "drive", "method": "radarsdf", "f_score_all": 0.3, "completion_ratio": 0.5},
        ],
    }
    made = {name: {"command": f"python -m nothing {name}", "rows": rows} for name, rows in parts.items()}
    return {
        "format": 1, "commit": "feedc0ffee", "date": "2099-12-31", "quick": False, "machine": dict(MACHINE),
        "experiments": made,
    }  # fmt: skip


@pytest.fixture(scope="module")
def written_once(tmp_path_factory):
    """The folder of a document, which no test changes."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "results.json").write_text(json.dumps(made_up_results()), encoding="utf-8")
    command.main(["write", str(folder / "results.json"), "--root", str(folder)])
    return folder


@pytest.fixture
def written(written_once, tmp_path):
    """The folder of a document, and the file of its results."""
    shutil.copytree(written_once, tmp_path, dirs_exist_ok=True)
    return tmp_path, tmp_path / "results.json"


@pytest.fixture
def without_plots(monkeypatch):
    """Most of the time of a document is that of its plots, which other tests look at."""
    monkeypatch.setattr(command, "draw", lambda *_: None)


def check(root, path):
    command.main(["write", "--check", str(path), "--root", str(root)])


def test_the_document_says_where_it_comes_from_and_what_was_measured(made_up):
    text = document(made_up)
    for words in ("feedc0ffee", "2099-12-31", "Imaginary 3000", "2 cores", "11 GB of memory", "PyTorch 9.9"):
        assert words in text, words
    assert "| radarsdf  | **75.0** | **65.0** |" in text
    assert "| `hugin` | 5.50     | 7.00 | 1.00  |" in text  # the mean of two seeds
    assert "10,000 returns take 10 s and 1.0 GB without intensities, 11 s and 1.0 GB with intensities" in text
    assert "| marching cubes, sphere, 256³ | 4.0 " in text
    assert "| 2.5 " in text
    assert "22 signed distances: 0.33 s" in text
    assert all(name in text for name in PLOTS)
    assert "python -m nothing curve" in text
    assert len(text.split()) < WORD_LIMIT


def test_a_missing_peer_says_why_once(made_up):
    text = document(made_up)
    assert text.count("holiday") == 1
    assert "- BPA, Poisson: Open3D is on holiday" in text
    assert "| BPA" not in text


def test_an_experiment_without_results_is_named(made_up):
    made_up["experiments"]["kernels"] = {
        "command": "python -m nothing",
        "why_not": "the compiler is on strike",
    }
    del made_up["experiments"]["growth"]
    text = document(made_up)
    assert "- kernels: the compiler is on strike" in text
    assert "- growth: not run" in text
    assert "## Kernels" not in text
    assert "## Growth" not in text


def test_a_quick_run_is_called_one_and_a_note_is_shown(made_up):
    assert "mean nothing" not in document(made_up)
    assert "mean nothing" in document(made_up | {"quick": True})
    assert "**taken** with a pinch" in document(made_up | {"note": "**taken** with a pinch"})


def test_who_is_ahead_on_real_scans_is_told_from_the_figures(made_up):
    assert "On all 1 drives the published octree, SHINE, is still ahead" in document(made_up)
    made_up["experiments"]["real"]["rows"][1]["f_score_all"] = 0.5
    assert "On 0 of 1 drives the published octree" in document(made_up)


def test_too_many_words_are_refused(made_up):
    made_up["experiments"]["surface"]["rows"][2]["why_not"] = "no " * WORD_LIMIT
    with pytest.raises(ValueError, match=f"and may have {WORD_LIMIT}"):
        document(made_up)


def test_the_same_results_give_the_same_files(written):
    root, path = written
    before = {name: (root / name).read_bytes() for name in ("BENCHMARK.md", *PLOTS)}
    command.main(["write", str(path), "--root", str(root)])
    assert before == {name: (root / name).read_bytes() for name in before}
    for name in PLOTS:
        assert before[name].startswith(b"\x89PNG")
        assert 5000 < len(before[name]) < 80_000
    check(root, path)


BLOCK = "<!-- measured: {} -->\n{}<!-- end -->\n"


@pytest.mark.usefixtures("without_plots")
def test_pages_get_the_figures_of_the_run(made_up, written):
    root, path = written
    page = root / "README.md"
    page.write_text(
        "# A page\n\n" + BLOCK.format("comparison", "It takes 1 s.\n") + "\n3 times\n", encoding="utf-8"
    )
    (root / "docs" / "a.md").write_text(BLOCK.format("growth", ""), encoding="utf-8")
    (root / "docs" / "b.md").write_text("No figures.\n", encoding="utf-8")
    with pytest.raises(SystemExit, match=r"the figures of README\.md are not those of"):
        check(root, path)
    command.main(["write", str(path), "--root", str(root)])
    check(root, path)
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# A page\n\n<!-- measured: comparison -->\n| scene `hugin`, simulated ")
    assert text.endswith("<!-- end -->\n\n3 times\n")
    assert "| **80.0 %** " in text
    assert "| 4.0 s " in text
    assert "commit feedc0ffee: `python -m nothing curve`" in text
    assert "1 s." not in text
    made_up["commit"] = "0ddba11"
    path.write_text(json.dumps(made_up), encoding="utf-8")
    with pytest.raises(SystemExit, match=r"run: python -m bench\.report write"):
        check(root, path)


def test_what_recorded_drives_say_follows_from_the_figures(made_up):
    def said():
        return " ".join(pages.measured(BLOCK.format("drives", ""), made_up).split())

    assert (
        "30.0 %, and those of the published octree (SHINE-Mapping) 40.0 %: radarsdf is ahead on 0 of 1."
        in said()
    )
    assert "the lidar's surface on 1 of them" in said()
    assert "nearest neighbours" not in said()  # hugin is no drive
    made_up["experiments"]["intensity"]["rows"] += [
        {"scene": "drive", "method": method, "mae": mae} for method, mae in (("kNN", 4.0), ("radarsdf", 3.0))
    ]
    assert "is 0.75 to 0.75 times that of the nearest neighbours" in said()
    del made_up["experiments"]["real"]
    assert "No recorded drive is in this run." in said()


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        (BLOCK.format("weather", ""), {}, "nothing is measured as weather"),
        ("<!-- measured: growth -->\nand no end\n", {}, "has no <!-- end -->"),
        (BLOCK.format("growth", ""), {"quick": True}, "mean nothing"),
    ],
)
def test_pages_that_cannot_have_the_figures_are_refused(text, changes, message, made_up, tmp_path):
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    path = tmp_path / "results.json"
    path.write_text(json.dumps(made_up | changes), encoding="utf-8")
    with pytest.raises(SystemExit, match=message):
        command.main(["write", str(path), "--root", str(tmp_path)])
    assert {file.name for file in tmp_path.iterdir()} == {"README.md", "results.json"}
    assert (tmp_path / "README.md").read_text(encoding="utf-8") == text


def test_results_without_an_experiment_give_a_document(made_up, tmp_path):
    made_up["experiments"] = {}
    path = tmp_path / "results.json"
    path.write_text(json.dumps(made_up), encoding="utf-8")
    command.main(["write", str(path), "--root", str(tmp_path)])
    check(tmp_path, path)


def test_check_fails_where_the_document_was_edited(written):
    root, path = written
    text = (root / "BENCHMARK.md").read_text(encoding="utf-8")
    (root / "BENCHMARK.md").write_text(text.replace("75.0", "99.9"), encoding="utf-8")
    with pytest.raises(SystemExit, match=r"BENCHMARK\.md is not what .* gives"):
        check(root, path)


def test_check_fails_where_a_plot_is_of_other_results(written, made_up):
    root, path = written
    made_up["experiments"]["curve"]["rows"][0]["seconds"] = 2.5  # in no table
    path.write_text(json.dumps(made_up), encoding="utf-8")
    with pytest.raises(SystemExit, match=r"error_over_time\.png was not drawn from"):
        check(root, path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 2}'])
def test_other_files_are_refused(text, tmp_path):
    path = tmp_path / "results.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"results of bench\.report|format 2"):
        results.read(path)


def test_parts_of_one_commit_are_merged(made_up):
    part = copy.deepcopy(made_up)
    part["experiments"] = {"curve": {"why_not": "tired"}, "new": {"rows": []}}
    merged = results.merge(made_up, part)
    assert list(merged["experiments"]) == [*made_up["experiments"], "new"]
    assert merged["experiments"]["curve"] == {"why_not": "tired"}
    assert merged["experiments"]["surface"] == made_up["experiments"]["surface"]


@pytest.mark.parametrize(
    "change", [{"commit": "0ddba11"}, {"machine": MACHINE | {"cores": 64}}, {"quick": True}, {"format": 0}]
)
def test_parts_of_different_runs_are_not(made_up, change):
    with pytest.raises(ValueError, match=f"another {next(iter(change))} cannot be merged"):
        results.merge(made_up, made_up | change)


@pytest.mark.parametrize("commit", ["feedc0ffee-dirty", "unknown"])
def test_files_that_no_commit_knows_are_merged_by_one_process_only(made_up, commit):
    made_up["commit"] = commit
    results.merge(made_up, made_up, same_process=True)
    with pytest.raises(ValueError, match="nobody knows"):
        results.merge(made_up, made_up)


def test_only_some_experiments_join_the_file(made_up, tmp_path, monkeypatch):
    made = made_up | {"experiments": {}}
    monkeypatch.setattr("bench.report.results.begin", lambda *, quick: copy.deepcopy(made | {"quick": quick}))
    asked = []

    def run(name, *, size, real):
        asked.append((name, size, len(real)))
        return {"rows": [{"what": name, "count": 1, "seconds": 1.0}]}

    monkeypatch.setattr(command, "run", run)
    path = tmp_path / "new" / "results.json"
    command.main(["run", "--out", str(path), "--real", "a.npz"])
    assert [name for name, *_ in asked] == list(experiments.NAMES)
    before = results.read(path)
    command.main(
        ["run", "--out", str(path), "--long", "--only", "queries", "real", "--real", "a.npz", "b.npz"]
    )
    assert asked[len(experiments.NAMES) :] == [("queries", "long", 2), ("real", "long", 2)]
    assert results.read(path) == before
    made["commit"] = "0ddba11"
    with pytest.raises(SystemExit, match="another commit"):
        command.main(["run", "--out", str(path), "--only", "queries"])
    assert results.read(path) == before
    command.main(["run", "--out", str(path)])  # all of them begin a new file
    assert results.read(path)["commit"] == "0ddba11"


def test_a_failed_experiment_is_in_the_file_and_fails_the_command(made_up, tmp_path, monkeypatch):
    made = made_up | {"experiments": {}}
    monkeypatch.setattr("bench.report.results.begin", lambda *, quick: copy.deepcopy(made | {"quick": quick}))
    monkeypatch.setattr(
        command, "run", lambda name, **_: {"why_not": "tired"} if name == "curve" else {"rows": []}
    )
    path = tmp_path / "results.json"
    with pytest.raises(SystemExit, match="failed: curve"):
        command.main(["run", "--out", str(path)])
    assert list(results.read(path)["experiments"]) == [name for name in experiments.NAMES if name != "real"]


def test_the_commit_is_that_of_the_files():
    commit = results.commit()
    assert commit == "unknown" or len(commit.removesuffix("-dirty")) >= 7
    assert results.begin(quick=True)["machine"]["cores"] >= 1


def test_a_command_that_fails_becomes_a_reason_without_folders():
    found = experiments._run(
        ("bench.paper", "surface", "nowhere.npz", "--out", "{folder}"),
        "surface.json",
        lambda values: values["rows"],
    )
    assert found["command"] == "python -m bench.paper surface nowhere.npz"
    assert "nowhere" in found["why_not"]
    assert str(ROOT) not in found["why_not"]
    assert "rows" not in found


def test_recorded_scans_are_measured_by_this_run_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "results.json"
    with pytest.raises(SystemExit, match="real needs recorded scans: --real"):
        command.main(["run", "--out", str(path), "--only", "real"])
    assert not path.exists()
    monkeypatch.setattr(experiments, "_run", lambda words, *_: {"words": words})
    drives = [tmp_path / "a.npz", tmp_path / "b.npz"]
    words = experiments.run("real", size="usual", real=drives)["words"]
    assert words[:4] == ("bench.paper", "surface", *map(str, drives))
    words = experiments.run("intensity", size="usual", real=drives)["words"]
    assert words[5:8] == (*map(str, drives), "--base")
    words = experiments.run("intensity", size="usual")["words"]
    assert words[4:6] == ("wall", "--base")


def test_commands_are_ones_that_exist():
    parsers = {"bench.paper": paper_command._parser(), "bench.growth": growth_command._parser()}
    for experiment in experiments.EXPERIMENTS.values():
        for module, *words in (experiment.words, experiment.quick, experiment.long):
            if module in parsers:
                parsers[module].parse_args(words)
            for case in (word for word in words if "::" in word):
                file, name = case.split("::")
                assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8")


def test_cases_that_were_skipped_are_told():
    text = "SKIPPED [2] bench/test_x.py:64: vtk is not installed\nPASSED\nSKIPPED [1] bench/y.py:6: no compiler: none"
    assert experiments._skipped(text) == ["vtk is not installed", "no compiler: none"]


@pytest.mark.parametrize("experiment", ["surface", "curve"])
def test_what_the_paper_s_experiments_write_can_be_shown(experiment, made_up, tmp_path, monkeypatch):
    mesh = trimesh.creation.icosphere(subdivisions=2)

    def reconstruct(peer, *_args, **_options):
        if peer.name == "VDBFusion":
            return Reconstruction(None, "it is not here")
        return Reconstruction(mesh, "", seconds=1.5, peak_bytes=10**8, report={"mesh_s": 0.5})

    monkeypatch.setattr("bench.paper.experiment.reconstruct", reconstruct)
    words = [word.replace("{folder}", str(tmp_path)) for word in experiments.EXPERIMENTS[experiment].quick]
    paper_command.main([*words[1:], "--samples", "1000"])
    values = json.loads((tmp_path / f"{experiment}.json").read_text())
    made_up["experiments"] = {experiment: {"rows": experiments.EXPERIMENTS[experiment].rows(values)}}
    text = document(made_up)
    assert "VDBFusion: it is not here" in text
    path = tmp_path / "results.json"
    path.write_text(json.dumps(made_up), encoding="utf-8")
    command.main(["write", str(path), "--root", str(tmp_path)])
    if experiment == "surface":
        assert "| radarsdf | **" in text
