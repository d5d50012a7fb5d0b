# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`BENCHMARK.md` and its plots, from one JSON that holds the results of one run at one commit."""
