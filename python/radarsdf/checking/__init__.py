# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Faults of scans and poses that their own data show, before a fit."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
