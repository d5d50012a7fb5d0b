"""Fields of signed distance and intensity, on a grid or neural, and autograd functions over the core."""

import torch  # noqa: F401 - before the compiled core, so that both share one OpenMP runtime
