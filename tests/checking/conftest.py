"""Checks without their slowest part."""

import pytest


@pytest.fixture
def right_frames(monkeypatch):
    """For tests that break no frame, axis or unit: testing 190 hypotheses on each pair of scans takes most of the time."""
    monkeypatch.setattr("radarsdf.checking.frames.check_frames", lambda *_: [])
