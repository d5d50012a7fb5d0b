"""Estimation and refinement of poses from returns."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
