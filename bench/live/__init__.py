# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps that grow scan by scan: rates, accuracy, exact removal, memory."""
