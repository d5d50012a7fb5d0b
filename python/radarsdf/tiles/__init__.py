"""Maps larger than one machine's memory: a plan, a fit per tile, and one map over all tiles."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
