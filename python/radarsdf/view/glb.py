# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A coloured mesh as the bytes of a GLB file, the one format in which viser takes colours of vertices."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.view.light import light_to_show

_UNLIT = "KHR_materials_unlit"  # the colours are as given, and those of the cloud and of the scale
_MATERIAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,  # the back of a surface is seen too, from below or from behind
    "extensions": {_UNLIT: {}},
}
_FLOAT, _UNSIGNED_INT = 5126, 5125


def glb(vertices: NDArray[Any], faces: NDArray[np.int32], colors: NDArray[np.uint8]) -> bytes:
    """Bytes of vertices (V, 3), which become float32, faces (F, 3) and sRGB colours (V, 3)."""
    positions = np.ascontiguousarray(vertices, np.float32)
    parts = (positions, np.ascontiguousarray(faces, np.uint32).reshape(-1, 1), light_to_show(colors))
    views, accessors, start = [], [], 0
    for part in parts:
        numbers = part.shape[1] == 3
        views.append({"buffer": 0, "byteOffset": start, "byteLength": part.nbytes})
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": _FLOAT if numbers else _UNSIGNED_INT,
                "count": len(part),
                "type": "VEC3" if numbers else "SCALAR",
            }
        )
        start += part.nbytes
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_MATERIAL],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return b"".join(
        [
            struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + start),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", start, b"BIN\0"),
            *(part.tobytes() for part in parts),
        ]
    )
