# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Pages are about words and files: what they fit need not be good."""

from __future__ import annotations

import dataclasses

import pytest
from radarsdf.budget.schedule import Schedule


@pytest.fixture(autouse=True)
def short_fits(monkeypatch):
    """A tenth of the training."""
    usual = Schedule.of

    def short(*given, **named):
        found = usual(*given, **named)
        return dataclasses.replace(
            found,
            sdf_iterations=min(found.sdf_iterations, 30),
            intensity_iterations=min(found.intensity_iterations, 60),
        )

    monkeypatch.setattr(Schedule, "of", short)
