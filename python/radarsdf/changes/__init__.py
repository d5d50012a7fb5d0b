# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Two maps of one place: what appeared, what is gone, what moved its surface, what changed its reflectance."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
