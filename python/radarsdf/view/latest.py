# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A value that threads change and one thread follows: the newest wins, older ones are never seen."""

from __future__ import annotations

import dataclasses
import threading
from typing import Any, Generic, TypeVar

_Value = TypeVar("_Value")


class Latest(Generic[_Value]):
    """Holds a frozen dataclass. Any thread may change it; one thread waits for changes."""

    def __init__(self, value: _Value) -> None:
        self._value = value
        self._changed = threading.Condition()
        self._version, self._taken, self._closed = 1, 0, False

    @property
    def newest(self) -> _Value:
        """The value."""
        with self._changed:
            return self._value

    def change(self, **fields: Any) -> None:
        """Replace fields of the value."""
        with self._changed:
            value: Any = self._value
            self._value = dataclasses.replace(value, **fields)
            self._version += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Let the thread that waits end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take(self) -> _Value | None:
        """Wait for a value that was not taken yet. None: it is closed."""
        with self._changed:
            self._changed.wait_for(self._is_news)
            self._taken = self._version
            return None if self._closed else self._value

    def news(self, within_s: float = 0.0) -> bool:
        """Whether the value that was taken last is not the newest any more, or is not in so many seconds."""
        with self._changed:
            return self._changed.wait_for(self._is_news, within_s)

    def _is_news(self) -> bool:
        return self._closed or self._version > self._taken
