# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Reads and writes files of scans, poses, point clouds and meshes. Imports only `checks` and `_core` of this package."""

from radarsdf.io.clouds import read_points
from radarsdf.io.meshes import write_mesh
from radarsdf.io.read import read
from radarsdf.io.scans import read_scans, write_scans
from radarsdf.io.sequence import Scan, Scans

__all__ = ["Scan", "Scans", "read", "read_points", "read_scans", "write_mesh", "write_scans"]
