# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Benches are programs of their own: what they set for their process must not stay for the next tests."""

from __future__ import annotations

import logging

import pytest


@pytest.fixture(autouse=True)
def log_as_before():
    """Some benches silence the notes of readers."""
    log = logging.getLogger("radarsdf.io")
    level = log.level
    yield
    log.setLevel(level)
