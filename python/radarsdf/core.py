"""The compiled core, loaded after PyTorch, so that both share one OpenMP runtime."""

import torch  # noqa: F401

from radarsdf._core import *  # noqa: F403
from radarsdf._core import __version__ as __version__  # noqa: PLC0414
