# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Grids for planners: what is occupied, free and unknown, distances, heights for wheels, and their files."""
