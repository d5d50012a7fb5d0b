# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is wrong with scans and poses, as far as they tell it themselves, before a fit."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
