# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A coloured mesh as the bytes of a GLB file, the one format in which viser takes colours of vertices."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange import gltf

_UNLIT = "KHR_materials_unlit"  # the colours are as given, and those of the cloud and of the scale
_MATERIAL = {
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,  # the back of a surface is seen too, from below or from behind
    "extensions": {_UNLIT: {}},
}
# glTF's colours of vertices are linear in light, those of screens and of radarsdf are sRGB.
_SRGB = np.arange(256) / 255
_LINEAR = np.rint(255 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)).astype(
    np.uint8
)


def glb(vertices: NDArray[Any], faces: NDArray[np.int32], colors: NDArray[np.uint8]) -> bytes:
    """Bytes of vertices (V, 3), which become float32, faces (F, 3) and sRGB colours (V, 3)."""
    mesh: Any = trimesh.Trimesh(vertices, faces, process=False)
    rgba = np.full((len(colors), 4), 255, np.uint8)
    rgba[:, :3] = _LINEAR[colors]
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=rgba)
    export: Any = gltf.export_glb
    data: bytes = export(trimesh.Scene(mesh), include_normals=False, tree_postprocessor=_with_material)
    return data


def _with_material(tree: dict[str, Any]) -> None:
    tree["materials"] = [_MATERIAL]
    tree["extensionsUsed"] = [_UNLIT]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
