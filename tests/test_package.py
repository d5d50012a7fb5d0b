"""The names of the package: complete, imported only when they are used, and with examples that run."""

import ast
import doctest
import importlib
import itertools
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
import radarsdf
from radarsdf import _core
from radarsdf.extras import REQUIREMENTS, require

if sys.version_info < (3, 11):
    import tomli as tomllib
else:
    import tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA_NAMES = {"torch": "pytorch-cpu", "matplotlib": "matplotlib-base"}


def run(code):
    """Run code in a new Python process without imports of the package."""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_importing_the_package_imports_nothing_else():
    run(
        "import sys; before = set(sys.modules); import radarsdf; dir(radarsdf);"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before};"
        "assert new - sys.stdlib_module_names == {'radarsdf'}, new"
    )


def test_public_names_equal_the_reference():
    """Detects removed names, and new ones that the reference lacks."""
    pages = (ROOT / "docs/api").glob("*.md")
    named = set()
    for page in pages:
        module = ""
        for line in page.read_text(encoding="utf-8").splitlines():
            if found := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = found[1]
            elif found := re.match(r"\.\. auto(?:class|function|exception):: (\w+)", line):
                named |= {found[1]} if module == "radarsdf" else set()
    assert named | {"evaluation", "io", "simulate"} == set(radarsdf.__all__)


def test_an_unknown_name():
    with pytest.raises(AttributeError, match="fitt"):
        radarsdf.fitt  # noqa: B018
    assert not hasattr(radarsdf, "_nothing")


def test_the_version_is_written_once():
    assert radarsdf.__version__ == _core.__version__ == PROJECT["version"]
    # The copies, for those who cite, and for conda.
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    recipe = (ROOT / "conda/recipe.yaml").read_text(encoding="utf-8")
    assert re.findall(r'version: "(.+)"', recipe) == [PROJECT["version"]]


def test_conda_and_pip_have_the_same_requirements():
    recipe = (ROOT / "conda/recipe.yaml").read_text(encoding="utf-8")
    asked = re.search(r"  run:\n((?:    - .+\n)+)", recipe)[1]
    found = {tuple(line[6:].partition("#")[0].split()) for line in asked.splitlines()}
    extras = PROJECT["optional-dependencies"]
    wanted = {("python", PROJECT["requires-python"])}
    for requirement in [*PROJECT["dependencies"], *extras["plot"], *extras["view"]]:
        name, limit = re.fullmatch(r"([\w-]+)(>=[\w.]+)(?:;.*)?", requirement.replace(" ", "")).groups()
        wanted.add((CONDA_NAMES.get(name, name), limit))
    assert found == wanted


def test_missing_packages_are_named_with_an_install_command(monkeypatch):
    extras = PROJECT["optional-dependencies"]
    wanted = {
        one
        for name in ("cluster", "foxglove", "las", "plot", "rerun", "ros", "ros2", "view")
        for one in extras[name]
        if not one.startswith("radarsdf[")
    }
    assert set(REQUIREMENTS.values()) == wanted
    for name in ("viser", "laspy"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=re.escape('viser and laspy: pip install "viser>=1.1" "laspy[')):
        require("json", "viser", "laspy", what="it takes")
    assert require("json", what="it takes").loads("1") == 1


OPENMP = """
import sys, radarsdf
radarsdf.marching_cubes  # whose module imports the core, but not PyTorch
if sys.platform == "linux":
    lines = open("/proc/self/maps").read().splitlines()
    libraries = {line.split()[-1] for line in lines if any(x in line for x in ("gomp", "iomp", "libomp"))}
    assert len(libraries) == 1, libraries
import radarsdf.threads, radarsdf.evaluation
"""


def test_the_core_shares_the_openmp_runtime_of_pytorch_and_names_unknown_instruction_sets_once():
    options = {"env": os.environ | {"RADARSDF_ISA": "nonsense"}, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", OPENMP], **options, timeout=60, check=True)
    assert done.stderr.count("RADARSDF_ISA=nonsense is none of baseline") == 1


MODULES = ["radarsdf"] + [
    module.name
    for module in pkgutil.walk_packages(radarsdf.__path__, "radarsdf.")
    if module.name
    not in ("radarsdf.__main__", "radarsdf._core")  # one runs the command line, one is compiled
]


def examples(name):
    module = importlib.import_module(name)
    return [test for test in doctest.DocTestFinder().find(module, name) if test.examples]


@pytest.mark.parametrize("test", [test for name in MODULES for test in examples(name)], ids=lambda t: t.name)
def test_example(test, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report = []
    failures, _ = doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert failures == 0, "".join(report)


def test_public_names_have_docstrings():
    assert [name for name in radarsdf.__all__ if not (getattr(radarsdf, name).__doc__ or "").strip()] == []


def test_docstrings_describe_each_parameter():
    """Regression: without an indent, a page showed the description of a parameter as its name."""
    for path in sorted(Path(radarsdf.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            doc = ast.get_docstring(node) if isinstance(node, ast.FunctionDef) else None
            section = re.search(r"^Parameters\n-+\n(.*?)(\n\n|\Z)", doc or "", re.DOTALL | re.MULTILINE)
            for name, described in itertools.pairwise(section[1].splitlines() if section else []):
                assert name.startswith(" ") or described.startswith(" "), (path.name, node.name, name)
