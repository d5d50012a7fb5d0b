# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How time and memory grow with the returns and with the scene: `python -m bench.growth`, on Linux."""
