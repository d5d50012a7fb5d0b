# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A page in the browser: the surface, the scans, and a sensor that can be dragged. It needs the extra `view`."""
