# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks without their longest part."""

import pytest


@pytest.fixture
def right_frames(monkeypatch):
    """For tests that break no frame, axis or unit: to try 190 of them on each pair of scans is most of a check's time."""
    monkeypatch.setattr("radarsdf.checking.frames.check_frames", lambda *_: [])
