# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is known of the returns before anything is learnt: rays, noise, planes, ghosts, support, gaps."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
