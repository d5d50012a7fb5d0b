# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which ways to break good data `radarsdf.check` names, and what it finds in good data."""
