# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Reads and writes files of scans, poses, point clouds and meshes. Imports only `checks` and `_core` of this package."""

from radarsdf.io.meshes import write_mesh
from radarsdf.io.scans import Scans, read_scans, write_scans

__all__ = ["Scans", "read_scans", "write_mesh", "write_scans"]
