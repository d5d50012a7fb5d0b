# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""No transcendental function of PyTorch's is called first by several threads at once: its bits could differ."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import radarsdf
from radarsdf import threads

ROOT = Path(radarsdf.__file__).parent
# What of PyTorch's has vectors, and in the last bits depends on who computes it. Not sqrt and norm, which IEEE 754 defines.
TRANSCENDENTAL = {
    "acos", "asin", "atan", "atan2", "binary_cross_entropy_with_logits", "cos", "cosh", "erf", "exp", "exp2", "expm1",
    "gelu", "hypot", "log", "log10", "log1p", "log2", "log_softmax", "logsigmoid", "normal_", "pow", "randn", "sigmoid",
    "sin", "sinh", "softmax", "softplus", "tan", "tanh",
}  # fmt: skip


def called(room):
    """Names of the functions and methods that a room's modules call, without NumPy's and the mathematical library's."""
    for path in (ROOT / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner = node.func.value
                if not (isinstance(owner, ast.Name) and owner.id in ("np", "math")):
                    yield node.func.attr


def test_all_that_are_used_are_called_first_by_one_thread():
    started = {*threads._TRANSCENDENTAL, "binary_cross_entropy_with_logits", "randn", "normal_"}
    used = {name for room in ("field", "fitting", "map") for name in called(room)} & TRANSCENDENTAL
    assert "log10" in used
    assert used <= started


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
    with threads.Workers(2) as workers:
        assert all(workers.map(lambda _: set(calls) == everything, range(8)))
assert len(calls) == len(everything)
"""


def test_before_the_first_work_and_only_once():
    subprocess.run([sys.executable, "-c", RECORDED], check=True)
