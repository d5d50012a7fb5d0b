# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps that do not fit into one machine's memory: a plan, a fit for each tile, and one map that answers from all."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
