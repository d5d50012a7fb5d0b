# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Figures of matplotlib, an extra. They need no display, and no setting of the user's is changed."""

from __future__ import annotations

import io
from typing import Any

from radarsdf.extras import require


def new_figure(**options: Any) -> Any:
    """A figure of matplotlib, which `options` are for.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    """
    require("matplotlib", what="pictures need")
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - an extra
    from matplotlib.figure import Figure  # noqa: PLC0415 - likewise

    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


def png_of(figure: Any, **options: Any) -> bytes:
    """The bytes of a PNG file."""
    file = io.BytesIO()
    figure.savefig(file, format="png", **options)
    return file.getvalue()
