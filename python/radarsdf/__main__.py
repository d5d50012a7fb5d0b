# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`python -m radarsdf`."""

import sys

from radarsdf.cli import main

sys.exit(main())
