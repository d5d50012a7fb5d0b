"""Serialisation of a map to a safetensors file, and to a pickle."""

import json
import math
from typing import Any

import numpy as np
import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors import SafetensorError
from torch import Tensor
from typing_extensions import TypedDict

from radarsdf.arrays import Array, Keys
from radarsdf.checks import AnyPath, check
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field, GridField, NeuralField
from radarsdf.io.files import check_regular_file, reading, write_whole
from radarsdf.io.tensors import open_tensors, tensor_bytes
from radarsdf.map.queries import MapContents
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.reflectance import Reflectance
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.view_statistics import FreeSpace, ViewStatistics
from radarsdf.settings import by_name, first_wrong

FORMAT = "radarsdf.map"
FORMAT_VERSION = 14
_UNITS = "positions and distances in m, world frame; signed distance positive in free space; intensities as measured"
# Types of the columns of `Evidence`.
_EVIDENCE = {"information": torch.float32, "hits": torch.uint32, "visibility": torch.uint32}
# Types and dimensions of the arrays of other parts. Bits and keys are stored as int64, which all readers of safetensors
# support; keys have at most 63 bits, like those of leaf cells.
_PARTS = {
    "free_space": {"keys": (torch.int64, 1), "planes": (torch.int64, 3)},
    "view_statistics": {
        "points": (torch.float32, 2), "directions": (torch.int8, 2), "ranges_m": (torch.float16, 1),
        "intensities": (torch.float32, 1), "counts": (torch.int16, 1),
    },
    "reflectance": {
        "coefficients": (torch.float64, 2), "table": (torch.float32, 2), "plane_keys": (torch.int64, 1),
        "normals": (torch.float32, 2), "mean_keys": (torch.int64, 1), "means": (torch.float16, 1),
    },
}  # fmt: skip


def save_contents(contents: MapContents, path: AnyPath) -> None:
    """Write a map to one file, atomically. Raise a ValueError if a number is not finite: it could not be loaded."""
    tensors, description = parts_of(contents)
    for name, tensor in tensors.items():
        check(tensor.isfinite().all(), f"{name} of the map contains non-finite numbers: the map is not saved")
    metadata = {"format": FORMAT, "format_version": str(FORMAT_VERSION), "units": _UNITS}
    write_whole(path, tensor_bytes(tensors, metadata | {"description": json.dumps(description)}))


@torch.inference_mode(mode=False)  # or the map could not compute gradients
def load_contents(path: AnyPath) -> MapContents:
    """Read the file of a map. Raise a ValueError if it is damaged, of another program or of another version."""
    check_regular_file(path)
    with reading(path, "a complete radarsdf map", Exception), open_tensors(path) as file:
        check(file.metadata.get("format") == FORMAT, "it has another format")
        version, known = file.metadata.get("format_version", ""), str(FORMAT_VERSION)
        check(version == known, f"it has format version {version!r}, this radarsdf {known}: fit it again")
        file.check_metadata()
        # Copy: the tensors are views of the file, which may be changed or removed.
        tensors = {name: file.array(name).clone() for name in file.names}
        return contents_of(tensors, json.loads(file.metadata["description"]))


def load_leaf_keys(path: AnyPath) -> Keys:
    """Read the ascending Morton keys (C,) of the leaf cells of a map, and nothing else of its file."""
    with reading(path, "a complete radarsdf map", SafetensorError), open_tensors(path, "np") as file:
        keys: Array = file.array("leaf_keys")
        ascending = keys.dtype == np.int64 and keys.ndim == 1 and (np.diff(keys, prepend=-1) > 0).all()
        check(ascending, "keys of leaf cells are not ascending")
        return keys.astype(np.uint64)


def file_bytes(contents: MapContents) -> int:
    """Return the size of the file of :func:`save_contents`, without the names of its arrays, bytes."""
    tensors, description = parts_of(contents)
    quoted = json.dumps(json.dumps(description))  # as quoted in the header, which is JSON itself
    return sum(tensor.nbytes for tensor in tensors.values()) + len(quoted)


def parts_of(contents: MapContents) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return all tensors of a map, and a description that JSON can store."""
    field, scale, reflectance = contents.field, contents.intensity_scale, contents.field.reflectance
    tensors: dict[str, Tensor] = {f"field.{name}": value for name, value in field.state_dict().items()}
    tensors["origin"] = torch.from_numpy(contents.origin)
    tensors["leaf_keys"] = torch.from_numpy(field.table.leaf_keys().astype(np.int64))
    tensors |= {name: torch.from_numpy(getattr(contents.evidence, name)) for name in _EVIDENCE}
    for part, columns in _PARTS.items():
        owner = reflectance if part == "reflectance" else getattr(contents, part)()
        for name in columns if owner is not None else ():
            array = getattr(owner, name)
            stored = array.view(np.int64) if array.dtype == np.uint64 else array
            tensors[f"{part}.{name}"] = torch.from_numpy(stored)
    description: dict[str, Any] = {
        "config": contents.config.to_dict(),
        "intensity_scale": None if scale is None else [scale.low, scale.high],
        "network_share": None if reflectance is None else reflectance.network_share,
        "view_sigma": contents.view_statistics().sigma,
        "clutter_ratio": contents.clutter_ratio,
        "returns_per_cell": contents.returns_per_cell,
        "sensor": contents.sensor.to_dict(),
        "report": contents.report,
    }
    if contents.sensors:  # labels may be of any type: JSON keeps numbers and text
        named = ((k if isinstance(k, (int, str)) else str(k), own) for k, own in contents.sensors.items())
        description["sensors"] = [[label, own.to_dict()] for label, own in named]
    return {name: tensor.contiguous() for name, tensor in tensors.items()}, description


def contents_of(tensors: dict[str, Tensor], description: dict[str, Any]) -> MapContents:
    """Invert :func:`parts_of`. Raise an exception of any type if parts are inconsistent."""
    config = FitConfig.from_dict(description["config"])
    origin = _taken(tensors, "origin", torch.float64, (3,))
    keys = _taken(tensors, "leaf_keys", torch.int64, (None,))
    evidence = {name: _taken(tensors, name, dtype, keys.shape) for name, dtype in _EVIDENCE.items()}
    check((evidence["information"] >= 0).all(), "information is negative")
    free_space = FreeSpace(**_arrays_of("free_space", tensors))
    free_space.check()
    sigma = float(description["view_sigma"])
    view_statistics = ViewStatistics(**_arrays_of("view_statistics", tensors), sigma=sigma)
    view_statistics.check(config.leaf_size_m)
    limits = description["intensity_scale"]
    scale = None if limits is None else IntensityScale.between(limits)
    share, reflectance = description["network_share"], None
    if share is not None:
        share = _in_range("network_share", share, 1)
        arrays = _arrays_of("reflectance", tensors)
        reflectance = Reflectance(config.leaf_size_m, **arrays, network_share=share)
        reflectance.check()
    # A map with intensities needs a network or a closed form to predict them; one without has neither.
    trained = scale is not None and config.trains_intensity
    answered = trained or reflectance is not None
    check(answered == (scale is not None), "a predictor of intensities is missing or superfluous")
    field = _field_of(tensors, keys.astype(np.uint64), config, trained)
    field.reflectance = reflectance
    return MapContents(
        field=field,
        origin=origin,
        intensity_scale=scale,
        config=config,
        report=checked_report(description["report"]),
        evidence=Evidence(**evidence),
        free_space=lambda: free_space,
        view_statistics=lambda: view_statistics,
        clutter_ratio=_in_range("clutter_ratio", description["clutter_ratio"], 1),
        returns_per_cell=_in_range("returns_per_cell", description["returns_per_cell"], math.inf),
        sensor=Sensor.from_dict(description["sensor"]),
        sensors={label: Sensor.from_dict(own) for label, own in description.get("sensors", [])},
    )


def _field_of(tensors: dict[str, Tensor], keys: Keys, config: FitConfig, with_intensity: bool) -> Field:
    # On the meta device, for shapes alone: a damaged description could request networks of any size.
    with torch.device("meta"):
        if config.train:
            field: Field = NeuralField(keys, config, with_intensity=with_intensity)
        else:
            field = GridField(keys, config.leaf_size_m)
    for name, tensor in tensors.items():
        finite = tensor.dtype == torch.float32 and tensor.isfinite().all()
        check(finite, f"{name} is not finite float32 numbers")
    state = {name.removeprefix("field."): tensor for name, tensor in tensors.items()}
    field.load_state_dict(state, assign=True)  # raises a RuntimeError for wrong names or shapes
    field.requires_grad_(False)
    return field


def _arrays_of(part: str, tensors: dict[str, Tensor]) -> dict[str, Any]:
    arrays = {}
    for name, (dtype, dimensions) in _PARTS[part].items():
        array = _taken(tensors, f"{part}.{name}", dtype, (None,) * dimensions)
        arrays[name] = array.view(np.uint64) if dtype == torch.int64 else array
    return arrays


def _taken(tensors: dict[str, Tensor], name: str, dtype: torch.dtype, shape: tuple[int | None, ...]) -> Array:
    """Pop a tensor of finite numbers of this type and shape; None stands for any length."""
    tensor = tensors.pop(name)
    fits = tensor.dtype == dtype and tensor.ndim == len(shape) and bool(tensor.isfinite().all())
    fits &= all(wanted in (None, length) for wanted, length in zip(shape, tensor.shape, strict=False))
    check(fits, f"{name} is not {shape} finite numbers, {dtype}")
    return tensor.numpy().copy()


def _in_range(name: str, value: Any, highest: float) -> float:
    found = float(value)
    check(0 <= found <= highest and found < math.inf, f"{name} must be in [0, {highest:g}], not {value}")
    return found


class _Report(TypedDict, total=False):
    """Schema of the parts of :attr:`Map.report` that other modules read, written by :func:`radarsdf.fitting.fit.fit_rays`."""

    __pydantic_config__ = ConfigDict(strict=True, extra="allow")  # type: ignore[misc]

    noise: dict[str, float]
    iterations: dict[str, int]
    losses: dict[str, float]
    loss_history: dict[str, dict[str, list[float]]]
    skipped: list[str]
    plan: str
    poses: dict[str, str | bool | float | list[float] | list[list[float]] | None]


_REPORT: TypeAdapter[Any] = TypeAdapter(_Report)


def checked_report(report: Any) -> dict[str, Any]:
    """Validate the report of a fit, from JSON. Raise a ValueError if parts of the schema have other types."""
    try:
        _REPORT.validate_python(by_name(report, "the report"))
    except ValidationError as error:
        msg = f"report.{first_wrong(error)}"
        raise ValueError(msg) from None
    return dict(report)
