# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps in tiles: beside one fit, over the returns, and while workers are killed: `python -m bench.tiles`, on Linux."""
