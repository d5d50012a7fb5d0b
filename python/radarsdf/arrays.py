"""Types of arrays by the type of their numbers, and of meshes; docstrings state shapes and units."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike as ArrayLike  # noqa: PLC0414 - for all modules
from numpy.typing import NDArray as NDArray  # noqa: PLC0414 - for all modules

if TYPE_CHECKING:
    import trimesh  # takes long

Mesh: TypeAlias = "trimesh.Trimesh"
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
