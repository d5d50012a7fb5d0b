"""Mistakes in scans and poses that are detectable before a fit."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
