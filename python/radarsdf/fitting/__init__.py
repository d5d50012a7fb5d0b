# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From returns to a map: sampling, gradients, optimisers, the training loop and checkpoints."""
