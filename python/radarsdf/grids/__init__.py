# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Grids for planners: occupied, free and unknown voxels, distances, costmaps, and their files."""
