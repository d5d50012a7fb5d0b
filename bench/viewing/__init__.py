# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a client of `radarsdf view` receives, and what a browser draws."""
