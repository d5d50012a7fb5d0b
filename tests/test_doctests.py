# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every example in a public docstring runs."""

import doctest
import importlib
import pkgutil

import pytest
import radarsdf

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


def test_what_is_public_has_a_docstring():
    assert [name for name in radarsdf.__all__ if not (getattr(radarsdf, name).__doc__ or "").strip()] == []
