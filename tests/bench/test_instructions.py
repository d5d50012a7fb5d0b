# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Counts of callgrind are added up by shared object, and what is too much is named."""

import pytest

from bench.instructions import by_object, faults
from bench.speed import packages_of

_CALLGRIND = """positions: line
events: Ir
desc: Trigger: Client Request: joint

ob=(1) /usr/lib/libm.so.6
fl=(1) ???
fn=(1) exp
0 70
ob=(2) /a/b/_core.so
fn=(2) step
10 5
+2 6
cob=(1)
cfn=(1)
calls=3 0
* 70
cob=(3) /usr/lib/libc.so.6
cfn=(4) memcpy
calls=1 0
-1 9
* 7
ob=(3)
fn=(4)
0 9
"""


def test_a_call_does_not_count_for_the_caller():
    assert by_object(_CALLGRIND) == {"libm.so.6": 70, "_core.so": 18, "libc.so.6": 9}


def test_what_is_too_much_is_named():
    expected = {"quick fit": 1000, "joint": 100}
    assert faults({"quick fit": 1100, "joint": 50, "new": 9}, expected, 1.01) == []
    found = faults({"quick fit": 1200, "joint": 116}, expected, 1.2)
    assert [fault.partition(":")[0] for fault in found] == [
        *expected,
        "a step depends on the number of returns",
    ]


def test_a_checkout_without_a_core_is_refused(tmp_path):
    with pytest.raises(ValueError, match="neither a wheel nor a checkout"):
        packages_of(tmp_path, tmp_path / "out")
    (tmp_path / "python" / "radarsdf").mkdir(parents=True)
    (tmp_path / "python" / "radarsdf" / "_core.so").touch()
    assert packages_of(tmp_path, tmp_path / "out") == tmp_path / "python"
