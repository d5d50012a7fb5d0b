# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Bags of ROS 1 and ROS 2: scans and poses, without ROS."""
