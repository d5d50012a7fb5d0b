"""Types of arrays by the type of their numbers; docstrings state shapes and units."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
AnyFloats = NDArray[np.floating]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Counts32 = NDArray[np.uint32]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Keys = NDArray[np.uint64]
"""Morton keys of cells, or hashes."""
