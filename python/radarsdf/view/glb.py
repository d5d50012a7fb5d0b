"""Coloured meshes as GLB, the one format in which viser takes vertex colours, and compensation of its tone mapping."""

from __future__ import annotations

import numpy as np

from radarsdf.arrays import Array, Bytes, Floats32
from radarsdf.io.glb import MATT, SRGB_TO_LINEAR, encode_glb

# Colours as they are, like those of point clouds and legends.
_UNLIT = MATT | {"extensions": {"KHR_materials_unlit": {}}}
_TO_LIGHT = np.array([-0.35, -0.5, 0.79])
_SHADE = 0.87  # lightness of faces averted from the light; higher keeps colours close to those of the legend

# viser's page passes all meshes, even unlit ones, through three.js's ACESFilmicToneMapping, which turns indigo into navy
# and yellow into olive. It is, on linear colours c:
#     _OUT @ ((x² + a x - b) / (c x² + d x + e)), with x = _IN @ c / _EXPOSURE
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 0.6
_FIT = (0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081)
_BITS = np.uint32(13)  # dropped mantissa bits, below the 256 levels of a screen: zeros compress better


def glb(vertices: Array, faces: Array, colors: Bytes) -> bytes:
    """Encode vertices (V, 3), as float32, faces (F, 3) and sRGB colours (V, 3) as the bytes of a GLB file."""
    return encode_glb(vertices, faces, {"COLOR_0": light_to_show(colors)}, material=_UNLIT)


def lightness_of(normals: Array) -> Floats32:
    """(V,) lightness factor, at most 1, for normals (V, 3), which makes the shape visible."""
    light = np.clip(np.asarray(normals, np.float64) @ _TO_LIGHT, 0.0, 1.0)
    return np.asarray(_SHADE + (1 - _SHADE) * light, np.float32)


def shaded(colors: Bytes, lightness: Array) -> Bytes:
    """Scale the OKLab lightness and chroma of sRGB colours (V, 3) by factors (V,): both are cube roots of light."""
    light = SRGB_TO_LINEAR[colors] * np.asarray(lightness, np.float64)[:, None] ** 3
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * srgb), np.uint8)


def light_to_show(colors: Bytes) -> Floats32:
    """(V, 3) linear colours of an unlit mesh that the page shows as these sRGB colours (V, 3): the inverse tone mapping."""
    a, b, c, d, e = _FIT
    y = SRGB_TO_LINEAR[colors] @ np.linalg.inv(_OUT).T
    square, slope, rest = 1 - c * y, a - d * y, -b - e * y
    x = (-slope + np.sqrt(np.maximum(slope**2 - 4 * square * rest, 0))) / (2 * square)
    light = np.ascontiguousarray(_EXPOSURE * x @ np.linalg.inv(_IN).T, np.float32)
    bits = light.view(np.uint32)
    half = np.uint32(1) << (_BITS - np.uint32(1))
    return ((bits + half) >> _BITS << _BITS).view(np.float32)
