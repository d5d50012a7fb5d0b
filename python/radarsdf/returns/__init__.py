"""Quantities computed from the returns before training: rays, noise, surfels, ghosts, support, gaps."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
