"""Checkpoints of a fit. A resumed fit is bit-identical to an uninterrupted one."""

import hashlib
import json
import time
import warnings
from typing import Any

from safetensors import SafetensorError
from torch import Tensor

from radarsdf import core
from radarsdf.checks import AnyPath, check, path_of, restating
from radarsdf.config.fit_config import FitConfig, flat_settings, settings_of_results
from radarsdf.io.files import check_regular_file, write_whole
from radarsdf.io.tensors import open_tensors, tensor_bytes
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays

FORMAT = "radarsdf.checkpoint"
_EVERY_S = 30.0  # minimum time between two writes, s
_SHARE = 0.02  # maximum share of the time spent on writing


class Checkpoint:
    """File with the state of the training, written every half minute, or less often if writing is slow.

    An existing file must be a checkpoint of the same fit: it stores the settings, and a digest of all returns and the scale of
    their intensities. Raises a ValueError if it is not a checkpoint, or has other scans, settings or version; an OSError if it
    cannot be read, or its folder does not exist.
    """

    def __init__(self, path: AnyPath, rays: Rays, scale: IntensityScale | None, config: FitConfig) -> None:
        self._path = path_of(path, "checkpoint")
        identity: dict[str, Any] = {"version": core.__version__, "scans": _digest(rays, scale)}
        identity["config"] = settings_of_results(config)
        self._identity: dict[str, Any] = json.loads(json.dumps(identity))
        self._next_s = time.monotonic() + _EVERY_S
        if self._path.exists():
            check_regular_file(self._path)
            self._check_identity()
        folder = self._path.parent
        check(folder.is_dir(), f"there is no folder {folder} for the checkpoint", FileNotFoundError)

    def due(self) -> bool:
        return time.monotonic() >= self._next_s

    def write(self, state: dict[str, Tensor]) -> None:
        """Replace the file. Failure only warns, because the fit can continue without it."""
        started_s = time.monotonic()
        metadata = {"format": FORMAT, "identity": json.dumps(self._identity)}
        try:
            write_whole(self._path, tensor_bytes(state, metadata))
        except OSError as error:
            warnings.warn(f"no checkpoint: {error}", RuntimeWarning, stacklevel=2)
        now_s = time.monotonic()
        self._next_s = now_s + max(_EVERY_S, (now_s - started_s) / _SHARE)

    def resume(self, training: Any) -> None:
        """Restore a `Training` from the file, if it exists. Raise a ValueError if it is damaged."""
        if not self._path.exists():
            return
        expected: dict[str, Tensor] = training.state()
        wrong = f"{self._path} is not a complete checkpoint of this fit"
        with restating(wrong, Exception, unless=OSError):  # damaged files raise exceptions of many kinds
            with open_tensors(self._path) as file:
                differing = sorted(set(file.names) ^ set(expected))
                check(not differing, f"{differing!s:.100} are missing or unexpected")
                state = {name: file.array(name).clone() for name in expected}
            for name, value in state.items():
                wanted = expected[name]
                fits = value.shape == wanted.shape and value.dtype == wanted.dtype and value.isfinite().all()
                check(fits, f"{name} is not {tuple(wanted.shape)} finite numbers, {wanted.dtype}")
            training.restore(state)

    def _check_identity(self) -> None:
        ours = self._identity
        try:
            with open_tensors(self._path) as file:
                metadata = file.metadata
            found: Any = json.loads(metadata["identity"]) if metadata.get("format") == FORMAT else None
            mine, other = flat_settings(ours["config"]), flat_settings(found["config"])
            differing = [name for name in ours if found[name] != ours[name]]
        except (SafetensorError, AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            msg = f"{self._path} is not a checkpoint of a fit: it is not overwritten"
            raise ValueError(msg) from error
        changed = sorted(name for name in mine.keys() | other.keys() if mine.get(name) != other.get(name))
        words = {
            "version": f"was written by radarsdf {found['version']!r:.50}: remove it to begin again",
            "config": f"is a checkpoint of another configuration: {', '.join(changed)!s:.200} differ",
            "scans": "is a checkpoint of other scans, poses or intensities",
        }
        for name, what in words.items():
            check(name not in differing, f"{self._path} {what}")


def _digest(rays: Rays, scale: IntensityScale | None) -> str:
    digest = hashlib.blake2b(repr(scale).encode(), digest_size=16)
    of_rig = (rays.stated, *(() if rays.sensor_of_scan is None else (rays.scans, rays.sensor_of_scan)))
    for array in (rays.origin, rays.points, rays.directions, rays.ranges_m, rays.intensities, *of_rig):
        digest.update(b"-" if array is None else array.data if array.flags.c_contiguous else array.tobytes())
    return digest.hexdigest()
