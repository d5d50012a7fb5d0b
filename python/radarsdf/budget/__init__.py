# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How long a fit trains, and what memory and time it takes: known before it begins."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
