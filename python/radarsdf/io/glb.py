"""GLB files: glTF 2.0 in binary form."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Floats

_SRGB = np.arange(256) / 255
SRGB_TO_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
"""(256,) linear light of each 8-bit sRGB value."""

_ROUGH = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
MATT: dict[str, Any] = {"pbrMetallicRoughness": _ROUGH, "doubleSided": True}
"""Material that shows the colours of the vertices."""

T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""(4, 4) rotation that turns z up into y up, as glTF demands."""

_FLOAT, _UNSIGNED_INT = 5126, 5125


def encode_glb(
    vertices: Array,
    faces: Array,
    attributes: Mapping[str, Array],
    *,
    material: Mapping[str, Any] = MATT,
    matrix: Floats | None = None,
    extras: Mapping[str, float] | None = None,
) -> bytes:
    """Encode a mesh of vertices (V, 3) and faces (F, 3). `attributes`: finite (V,) or (V, 3), linear colours as COLOR_0.

    `matrix`: (4, 4) transform of the mesh. `extras`: numbers kept with it. Vertices and attributes become float32.
    """
    of_vertices = {"POSITION": vertices, **attributes}
    parts = [np.ravel(faces).astype(np.uint32)]
    parts += [np.ascontiguousarray(values, np.float32) for values in of_vertices.values()]
    sizes = [part.nbytes for part in parts]
    accessors = [
        {
            "bufferView": number,
            "componentType": _FLOAT if number else _UNSIGNED_INT,
            "count": len(part),
            "type": "SCALAR" if part.ndim == 1 else "VEC3",
            "min": np.atleast_1d(part.min(axis=0)).tolist(),
            "max": np.atleast_1d(part.max(axis=0)).tolist(),
        }
        for number, part in enumerate(parts)
    ]
    numbers = dict(zip(of_vertices, range(1, len(parts)), strict=True))
    primitive = {"attributes": numbers, "indices": 0, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": np.ravel(np.eye(4) if matrix is None else matrix, "F").tolist()}],
        "meshes": [{"primitives": [primitive], "extras": extras or {}}],
        "materials": [material],
        "buffers": [{"byteLength": sum(sizes)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": sum(sizes[:i]), "byteLength": size} for i, size in enumerate(sizes)
        ],
        "accessors": accessors,
    }
    if "extensions" in material:
        tree["extensionsUsed"] = list(material["extensions"])
    text = json.dumps(tree, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + sum(sizes))
    chunks = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", sum(sizes), b"BIN\0")]
    return b"".join([header, *chunks, *(part.tobytes() for part in parts)])
