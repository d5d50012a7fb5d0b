# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From scans with poses to a map: the steps of a fit, its two stages, and what it will cost."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
