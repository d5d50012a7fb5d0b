# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses: what the returns say of them."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
