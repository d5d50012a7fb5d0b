# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Writes and reads a map as one safetensors file, and as a pickle."""

from __future__ import annotations

import json
import math
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes
from torch import Tensor

from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.grid_field import GridField
from radarsdf.field.neural_field import NeuralField
from radarsdf.io.files import check_regular_file, write_whole
from radarsdf.io.tensors import open_tensors, tensor_bytes
from radarsdf.map.contents import MapContents
from radarsdf.map.fit_report import checked_report
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.free_space import Passages
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.reflectance import Reflectance
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import Echoes

FORMAT = "radarsdf.map"
FORMAT_VERSION = 12
_UNITS = "positions and distances in m, world frame; signed distance positive in free space; intensities as measured"
# Types of the columns of `Evidence`.
_EVIDENCE = {"information": torch.float32, "detections": torch.uint32, "looks": torch.uint32}
# Types and numbers of dimensions of the arrays of other parts. Bits and keys are stored as int64, which all readers of
# safetensors have; keys have at most 63 bits, as those of leaf cells.
_PARTS = {
    "passages": {"keys": (torch.int64, 1), "planes": (torch.int64, 3)},
    "echoes": {
        "points": (torch.float32, 2),
        "directions": (torch.int8, 2),
        "ranges_m": (torch.float16, 1),
        "intensities": (torch.float32, 1),
        "counts": (torch.int16, 1),
    },
    "reflectance": {
        "coefficients": (torch.float64, 2),
        "table": (torch.float32, 2),
        "plane_keys": (torch.int64, 1),
        "normals": (torch.float32, 2),
        "mean_keys": (torch.int64, 1),
        "means": (torch.float16, 1),
    },
}


def save_contents(contents: MapContents, path: str | PathLike[str]) -> None:
    """Writes a map to one file. An old file at `path` is replaced only once the new one is complete.

    If the process is killed meanwhile, a hidden file ``.NAME.`` with 16 hexadecimal digits may stay beside
    it.

    Raises
    ------
    ValueError
        If a number of the map is not finite. :func:`load_contents` would refuse the file.
    """
    tensors, description = parts_of(contents)
    for name, tensor in tensors.items():
        if not tensor.isfinite().all():
            msg = f"{name} of the map holds something other than finite numbers: it is not saved"
            raise ValueError(msg)
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "units": _UNITS,
        "description": json.dumps(description),
    }
    write_whole(path, tensor_bytes(tensors, metadata))


def file_bytes(contents: MapContents) -> int:
    """Size of the file of :func:`save_contents`, without the names of its arrays, bytes."""
    tensors, description = parts_of(contents)
    quoted = json.dumps(json.dumps(description))  # as it stands in the header, which is JSON itself
    return sum(tensor.nbytes for tensor in tensors.values()) + len(quoted)


def to_pickle(contents: MapContents) -> tuple[bytes, dict[str, Any]]:
    """The contents of a map's pickle: tensors as bytes, so that it does not contain classes of PyTorch."""
    tensors, description = parts_of(contents)
    return to_bytes(tensors), description


@torch.inference_mode(mode=False)
def from_pickle(data: bytes, description: dict[str, Any]) -> MapContents:
    """The inverse of :func:`to_pickle`."""
    return _build(from_bytes(data), description)


def parts_of(contents: MapContents) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """All tensors of a map, and a description that JSON can store."""
    tensors: dict[str, Tensor] = {
        f"field.{name}": value for name, value in contents.field.state_dict().items()
    }
    tensors["origin"] = torch.from_numpy(contents.origin)
    # Morton keys have 63 bits, so they fit into int64, which all readers of safetensors have.
    tensors["leaf_keys"] = torch.from_numpy(contents.field.table.leaf_keys().astype(np.int64))
    tensors |= {name: torch.from_numpy(getattr(contents.evidence, name)) for name in _EVIDENCE}
    tensors |= _tensors_of("passages", contents.passages)
    tensors |= _tensors_of("echoes", contents.echoes)
    reflectance = contents.field.reflectance
    if reflectance is not None:
        tensors |= _tensors_of("reflectance", reflectance)
    scale = contents.intensity_scale
    description = {
        "config": contents.config.to_dict(),
        "intensity_scale": None if scale is None else [scale.low, scale.high],
        "network_share": None if reflectance is None else reflectance.network_share,
        "echo_sigma": contents.echoes.sigma,
        "rough_share": contents.rough_share,
        "returns_per_cell": contents.returns_per_cell,
        "sensor": contents.sensor.to_dict(),
        "report": contents.report,
    }
    return {name: tensor.contiguous() for name, tensor in tensors.items()}, description


def _tensors_of(part: str, owner: Passages | Echoes | Reflectance) -> dict[str, Tensor]:
    arrays = {f"{part}.{name}": getattr(owner, name) for name in _PARTS[part]}
    return {
        name: torch.from_numpy(array.view(np.int64) if array.dtype == np.uint64 else array)
        for name, array in arrays.items()
    }


def _arrays_of(part: str, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Takes the arrays of a part from the tensors. Raises a ValueError if one is of another type, or is not finite."""
    arrays = {}
    for name, (dtype, dimensions) in _PARTS[part].items():
        tensor = tensors.pop(f"{part}.{name}")
        if tensor.dtype != dtype or tensor.ndim != dimensions or not tensor.isfinite().all():
            msg = f"{name} of the {part} is not {dimensions}-dimensional, finite and {dtype}"
            raise ValueError(msg)
        array = tensor.numpy().copy()
        arrays[name] = array.view(np.uint64) if dtype == torch.int64 else array
    return arrays


def _reflectance_of(tensors: dict[str, Tensor], leaf_size_m: float, network_share: float) -> Reflectance:
    if not 0 <= network_share <= 1:
        msg = f"network_share must be in [0, 1], not {network_share}"
        raise ValueError(msg)
    arrays = _arrays_of("reflectance", tensors)
    reflectance = Reflectance(leaf_size_m, **arrays, network_share=network_share)
    reflectance.check()
    return reflectance


@torch.inference_mode(mode=False)  # or the map could not give gradients
def load_contents(path: str | PathLike[str]) -> MapContents:
    """Reads the file of a map. Nothing in the file is executed.

    Raises
    ------
    ValueError
        If the file is not a radarsdf map, is damaged, or is of another version of the format.
    OSError
        If the file cannot be read.
    """
    check_regular_file(path)
    try:
        with open_tensors(path) as file:
            metadata = file.metadata
            _check_format(metadata, path)
            # Copied, because the tensors are views of the file, which may be changed or removed.
            tensors = {name: file.array(name).clone() for name in file.names}
        return _build(tensors, json.loads(metadata["description"]))
    except (OSError, _OtherFileError):
        raise
    except SafetensorError as error:
        raise _damaged(path) from error
    except Exception as error:  # damaged files raise exceptions of many kinds
        msg = f"{path} is not a whole radarsdf map: {error}"
        raise ValueError(msg) from error


def load_leaf_keys(path: str | PathLike[str]) -> NDArray[np.uint64]:
    """(C,) Morton keys of the leaf cells of a map, ascending. Nothing else of its file is read or checked.

    Raises
    ------
    ValueError
        If the file has none.
    OSError
        If it cannot be read.
    """
    try:
        with open_tensors(path, "np") as file:
            keys: NDArray[Any] = file.array("leaf_keys")
    except (SafetensorError, ValueError) as error:
        raise _damaged(path) from error
    if keys.dtype != np.int64 or keys.ndim != 1 or not (np.diff(keys, prepend=-1) > 0).all():
        raise _damaged(path)
    return keys.astype(np.uint64)


def _damaged(path: str | PathLike[str]) -> ValueError:
    return ValueError(
        f"{path} is not a whole radarsdf map: it is cut off, damaged, or of another kind; radarsdf fit writes maps"
    )


class _OtherFileError(ValueError):
    """The file is of another program, or of another version of the format."""


def _check_format(metadata: dict[str, str], path: str | PathLike[str]) -> None:
    if metadata.get("format") != FORMAT:
        msg = f"{path} is not a radarsdf map"
        raise _OtherFileError(msg)
    version = metadata.get("format_version", "")
    if not version.isdecimal() or len(version) > 9 or int(version) != FORMAT_VERSION:
        msg = f"{path} has format version {version!r}; this radarsdf reads version {FORMAT_VERSION}: fit it anew (CHANGELOG, 0.2.0)"
        raise _OtherFileError(msg)


def _build(tensors: dict[str, Tensor], description: dict[str, Any]) -> MapContents:
    config = FitConfig.from_dict(description["config"])
    origin = tensors.pop("origin")
    if origin.shape != (3,) or origin.dtype != torch.float64 or not origin.isfinite().all():
        msg = "the origin is not three finite numbers"
        raise ValueError(msg)
    leaf_keys = tensors.pop("leaf_keys")
    if leaf_keys.ndim != 1 or leaf_keys.dtype != torch.int64:
        msg = "leaf_keys is not one key for each leaf cell"
        raise ValueError(msg)
    evidence = {name: tensors.pop(name) for name in _EVIDENCE}
    for name, tensor in evidence.items():
        if tensor.shape != leaf_keys.shape or tensor.dtype != _EVIDENCE[name]:
            msg = f"{name} is not one number for each leaf cell"
            raise ValueError(msg)
    if not (evidence["information"].isfinite() & (evidence["information"] >= 0)).all():
        msg = "information holds something other than finite numbers of at least 0"
        raise ValueError(msg)
    passages = Passages(**_arrays_of("passages", tensors))
    passages.check()
    echoes = Echoes(**_arrays_of("echoes", tensors), sigma=float(description["echo_sigma"]))
    echoes.check(config.leaf_size_m)
    scale = None
    if description["intensity_scale"] is not None:
        scale = IntensityScale.between(description["intensity_scale"])
    rough_share = float(description["rough_share"])
    if not 0 <= rough_share <= 1:
        msg = f"rough_share must be in [0, 1], not {rough_share}"
        raise ValueError(msg)
    returns_per_cell = float(description["returns_per_cell"])
    if not 0 <= returns_per_cell < math.inf:
        msg = f"returns_per_cell must be finite and at least 0, not {returns_per_cell}"
        raise ValueError(msg)
    share = description["network_share"]
    reflectance = None if share is None else _reflectance_of(tensors, config.leaf_size_m, float(share))
    # One of the two must answer for intensities, and without them neither can.
    trained = scale is not None and config.trains_intensity
    if (trained or reflectance is not None) != (scale is not None):
        msg = "what answers for intensities is missing, or there are none"
        raise ValueError(msg)
    field = _field_of(leaf_keys.numpy().astype(np.uint64), config, trained)
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or not tensor.isfinite().all():
            msg = f"{name} holds something other than finite float32 numbers"
            raise ValueError(msg)
    state = {name.removeprefix("field."): tensor for name, tensor in tensors.items()}
    field.load_state_dict(state, assign=True)  # raises a RuntimeError for wrong names or shapes
    field.reflectance = reflectance
    field.requires_grad_(False)
    return MapContents(
        field=field,
        origin=origin.numpy(),
        intensity_scale=scale,
        config=config,
        report=checked_report(description["report"]),
        evidence=Evidence(**{name: tensor.numpy().copy() for name, tensor in evidence.items()}),
        passages=passages,
        echoes=echoes,
        rough_share=rough_share,
        returns_per_cell=returns_per_cell,
        sensor=Sensor.from_dict(description["sensor"]),
    )


def _field_of(leaf_keys: NDArray[np.uint64], config: FitConfig, with_intensity: bool) -> Field:
    """The field without memory: a damaged description could ask for networks of any size, and shapes are checked later."""
    with torch.device("meta"):
        if config.train:
            return NeuralField(leaf_keys, config, with_intensity=with_intensity)
        return GridField(leaf_keys, config.leaf_size_m)
