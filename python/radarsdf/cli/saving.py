# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Saves the map of a command, and elsewhere if that fails. A fit is too much work to be lost for its file's name."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from radarsdf import RadarMap


def save_map(radar_map: RadarMap, path: Path) -> None:
    """Save a map, in a new file of the temporary folder if it cannot be written to `path`.

    Parameters
    ----------
    radar_map
        The map.
    path
        Where it should go. It was checked before the work, so it fails only for what happened meanwhile.

    Raises
    ------
    OSError
        If the map is not in `path`. The message says why, and where it is instead, or why it is nowhere.
    """
    try:
        radar_map.save(path)
    except (OSError, ValueError) as error:  # ValueError: it is no regular file any more
        why = _reason(error)
        try:
            kept = _save_in_temporary_folder(radar_map, path)
        except (OSError, ValueError) as second:
            msg = f"{path} cannot be written ({why}), nor can a file in the temporary folder ({_reason(second)}): the map is lost"
            raise OSError(msg) from error
        msg = f"{path} cannot be written ({why}): the map was saved in {kept} instead"
        raise OSError(msg) from error


def _save_in_temporary_folder(radar_map: RadarMap, path: Path) -> Path:
    descriptor, name = tempfile.mkstemp(prefix="radarsdf_", suffix=path.suffix)
    os.close(descriptor)
    kept = Path(name)
    try:
        radar_map.save(kept)
    except BaseException:
        kept.unlink(missing_ok=True)
        raise
    return kept


def _reason(error: Exception) -> str:
    """Why a file was not written, without the name of the hidden file that would have been renamed to it."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
