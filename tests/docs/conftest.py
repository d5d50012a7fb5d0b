"""Short fits of short drives."""

import pytest

from ..short import shorten


@pytest.fixture(autouse=True)
def short(monkeypatch):
    shorten(monkeypatch.setattr)
