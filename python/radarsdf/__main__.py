"""`python -m radarsdf`."""

import sys

from radarsdf.cli import main

sys.exit(main())
