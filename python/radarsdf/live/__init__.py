"""Incremental mapping, scan by scan: :class:`LiveMap`."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
