# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the returns of a radar are like, measured against lidar: recorded drives beside simulated ones."""
