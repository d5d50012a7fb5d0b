# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Long versions of tests that take seconds: rounding errors, damaged files, killed processes, random arguments."""
