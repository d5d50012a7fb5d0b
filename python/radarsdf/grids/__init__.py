# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Grids for planners: what is occupied, free and unknown, distances, heights for wheels, and their files."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
