"""The fitted map: queries, meshes, and storage in a file."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
