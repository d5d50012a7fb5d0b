# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is known of the returns before anything is learnt: rays, noise, planes, ghosts, support, gaps."""
