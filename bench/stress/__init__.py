# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Long versions of what the tests do in seconds: rounding errors, damaged files, killed savers, random arguments."""
