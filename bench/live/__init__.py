# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Live maps: rates, accuracy, exact removal, memory."""
