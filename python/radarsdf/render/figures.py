# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Figures of matplotlib, an extra. They need no display, and no setting of the user's is changed."""

from __future__ import annotations

import io
from typing import Any


def new_figure(**options: Any) -> Any:
    """A figure of matplotlib, which `options` are for.

    Raises
    ------
    ImportError
        If matplotlib is not installed. It comes with the extra `plot`.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        msg = 'pictures need matplotlib: pip install "radarsdf[plot]"'
        raise ImportError(msg) from error
    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


def png_of(figure: Any, **options: Any) -> bytes:
    """The bytes of a PNG file."""
    file = io.BytesIO()
    figure.savefig(file, format="png", **options)
    return file.getvalue()
