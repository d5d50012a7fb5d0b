# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Colours as light: a shade that keeps the hue, and what to send so that the page shows a colour as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SRGB = np.arange(256) / 255
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)

# The page of viser passes all meshes, also those without light, through three.js's ACESFilmicToneMapping, which turns
# indigo into navy and yellow into olive. It is, on linear colours c:
#     _OUT @ ((x² + a x - b) / (c x² + d x + e)), with x = _IN @ c / _EXPOSURE
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_EXPOSURE = 0.6
_FIT = (0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081)
_BITS = np.uint32(
    13
)  # of 23 of a number: the others are finer than the 256 steps of a screen, and cost bytes


def shaded(colors: NDArray[np.uint8], lightness: NDArray[Any]) -> NDArray[np.uint8]:
    """Colours (V, 3) with their lightness times a factor (V,), at most 1. The hue stays.

    The lightness of OKLab is the cube root of light, and so is its chroma.
    """
    light = _LINEAR[colors] * np.asarray(lightness, np.float64)[:, None] ** 3
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    shown: NDArray[np.uint8] = np.rint(255 * srgb).astype(np.uint8)
    return shown


def light_to_show(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(V, 3) light of a mesh without lamps that the page shows in these sRGB colours (V, 3)."""
    a, b, c, d, e = _FIT
    y = _LINEAR[colors] @ np.linalg.inv(_OUT).T
    square, slope, rest = 1 - c * y, a - d * y, -b - e * y
    x = (-slope + np.sqrt(np.maximum(slope**2 - 4 * square * rest, 0))) / (2 * square)
    light = np.ascontiguousarray(_EXPOSURE * x @ np.linalg.inv(_IN).T, np.float32)
    bits = light.view(np.uint32)
    half = np.uint32(1) << (_BITS - np.uint32(1))
    return ((bits + half) >> _BITS << _BITS).view(np.float32)
