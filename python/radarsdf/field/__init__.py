# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The learnt field: encodings, networks, losses, and autograd functions over the compiled core."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
