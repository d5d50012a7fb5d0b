# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Reads and writes files of scans, poses and point clouds. Imports only `checks` and `_core` of this package."""
