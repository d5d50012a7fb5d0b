# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""No transcendental function of PyTorch's is called first by several threads at once: its bits could differ."""

import subprocess
import sys

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


def test_before_the_first_work_and_only_once():
    subprocess.run([sys.executable, "-c", RECORDED], check=True)
