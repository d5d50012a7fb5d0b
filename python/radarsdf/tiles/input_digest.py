# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A digest of scans, to know them again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from radarsdf.io.scans import Scan


class InputDigest:
    """Tells whether scans are those of a plan."""

    def __init__(self) -> None:
        self._digest = hashlib.blake2b(digest_size=16)

    def add(self, scan: Scan) -> None:
        """The next scan."""
        for array in (scan.points, scan.T_world_sensor, scan.intensities, scan.doppler_mps):
            self._digest.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())

    def hex(self) -> str:
        """The digest of all scans so far."""
        return self._digest.hexdigest()

    @classmethod
    def of(cls, scans: Iterable[Scan]) -> str:
        """The digest of all scans."""
        digest = cls()
        for scan in scans:
            digest.add(scan)
        return digest.hex()
