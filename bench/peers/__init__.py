# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Other methods for the same job, each run in a process of its own; see `interface`.

Imports nothing: the children of Pythons too old for radarsdf come through here.
"""
