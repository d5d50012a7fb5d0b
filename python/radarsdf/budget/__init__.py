# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The number of iterations of a fit, and estimates of its memory and time before it begins."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
