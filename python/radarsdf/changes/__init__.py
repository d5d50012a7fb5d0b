"""Changes between two maps of one place: surface that appeared, disappeared or moved, and changed reflectance."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
