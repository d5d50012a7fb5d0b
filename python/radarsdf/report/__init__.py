# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One page about a map, for the browser. It needs the extras `plot` and `view`."""
