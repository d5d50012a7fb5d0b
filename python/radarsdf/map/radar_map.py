"""The map that a fit returns, and its file: safetensors, whose parts also make a pickle."""

import json
import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor
from typing_extensions import TypedDict

from radarsdf.arrays import Array, Bools, Floats, Keys
from radarsdf.checks import MAX_POSITION_M, AnyPath, check, check_box, positive
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field, GridField, NeuralField
from radarsdf.io.files import check_regular_file, reading, write_whole
from radarsdf.io.npz import check_arrays
from radarsdf.io.tensors import open_tensors, tensor_bytes
from radarsdf.map.confidence import CellsInBox, EvidenceAt, dense_cells, evidence
from radarsdf.map.map import Map, Query
from radarsdf.map.mesh import Surface
from radarsdf.map.queries import MapContents, into_cells, to_local, where
from radarsdf.map.threshold import Limits
from radarsdf.map.view import ViewedMap
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.reflectance import Reflectance
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import lattice_of
from radarsdf.returns.view_statistics import FreeSpace, ViewStatistics, ViewStatisticsAt
from radarsdf.settings import by_name, first_wrong

FORMAT = "radarsdf.map"
FORMAT_VERSION = 14
_UNITS = "positions and distances in m, world frame; signed distance positive in free space; intensities as measured"
_EVIDENCE = {"information": np.float32, "hits": np.uint32, "visibility": np.uint32}  # types of its columns
# Types and shapes of the arrays of other parts. Bits and keys (63 bits) are int64, which all readers of safetensors support.
_PARTS: dict[str, dict[str, tuple[Any, ...]]] = {
    "free_space": {"keys": (np.int64, None), "planes": (np.int64, None, None, None)},
    "view_statistics": {
        "points": (np.float32, None, None), "directions": (np.int8, None, None), "ranges_m": (np.float16, None),
        "intensities": (np.float32, None), "counts": (np.int16, None),
    },
    "reflectance": {
        "coefficients": (np.float64, None, None), "table": (np.float32, None, None), "plane_keys": (np.int64, None),
        "normals": (np.float32, None, None), "mean_keys": (np.int64, None), "means": (np.float16, None),
    },
}  # fmt: skip


class RadarMap(Map):
    """Fitted map in one file, created by :func:`radarsdf.fit` or :func:`radarsdf.load`. See :class:`Map` for its queries."""

    def __init__(self, contents: MapContents) -> None:
        self._contents = contents

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return f"RadarMap({kind}, {self.num_cells} cells, {self.file_bytes / 1e6:.1f} MB)"

    def __reduce__(self) -> "tuple[Callable[..., RadarMap], tuple[Any, ...]]":
        tensors, description = parts_of(self._contents)
        return _from_pickle, (save(tensors), description)  # bytes: the pickle needs no classes of PyTorch

    def _evaluate(self, query: Query, world: Floats, *others: Floats, extrapolate: bool) -> Array:
        points, *rest = (to_local(self._contents, x) for x in (world, *others))
        inside = into_cells(self._contents, points)
        known: Any = np.isfinite(points).all(axis=1) if extrapolate else inside
        for x in rest:
            known = known & np.isfinite(x).all(axis=1)
        return where(known, query, self._contents, points, *rest)

    def _observed(self, world: Floats) -> Bools:
        return into_cells(self._contents, to_local(self._contents, world))

    @property
    def contents_of_any(self) -> MapContents:
        return self._contents

    def _surface_mesh(self, voxel_size: float, *, box: Any, progress: bool | None, **wanted: Any) -> Any:
        voxel_m = positive(voxel_size, "voxel_size")
        check(voxel_m <= MAX_POSITION_M, f"voxel_size must be at most {MAX_POSITION_M:g} m, not {voxel_m}")
        limits = Limits.of(voxel_m, **wanted)
        local_box = None if box is None else check_box(box) - self.origin
        surface = Surface.of(self._contents, voxel_m, local_box, progress)
        return surface.mesh(self.origin, limits, self.num_cells)

    def cells_near(self, lower: Floats, upper: Floats) -> CellsInBox:
        leaf_m = self.config.leaf_size_m
        first = np.floor((lower - self.origin) / leaf_m).astype(np.int64)
        count = np.floor((upper - self.origin) / leaf_m).astype(np.int64) - first + 1
        x, y, z = count.tolist()
        cells = dense_cells(self._contents, first, (x, y, z))
        return CellsInBox(self.origin + first * leaf_m, *cells)

    def evidence_at(self, world: Floats) -> EvidenceAt:
        return evidence(self._contents, to_local(self._contents, world))

    def view_statistics(self) -> ViewStatisticsAt:
        return self._contents.views_in_world()

    def _viewed_from(self, position: Floats, range_m: float) -> ViewedMap:  # noqa: ARG002 - the whole map
        return self._viewed

    @cached_property
    def _viewed(self) -> ViewedMap:
        return ViewedMap.of(self._contents)

    def save(self, path: AnyPath) -> None:
        tensors, description = parts_of(self._contents)
        for name, tensor in tensors.items():  # what is not finite could not be loaded
            finite = tensor.isfinite().all()
            check(finite, f"{name} of the map contains non-finite numbers: the map is not saved")
        metadata = {"format": FORMAT, "format_version": str(FORMAT_VERSION), "units": _UNITS}
        write_whole(path, tensor_bytes(tensors, metadata | {"description": json.dumps(description)}))

    @property
    def origin(self) -> Floats:
        return self._contents.origin

    @property
    def extent(self) -> Floats:
        cells = lattice_of(self.field.table.leaf_keys())
        corners = np.stack([cells.min(axis=0), cells.max(axis=0) + 1])
        return corners * self.config.leaf_size_m + self.origin

    @property
    def num_cells(self) -> int:
        return len(self.evidence.visibility)

    @property
    def file_bytes(self) -> int:
        tensors, description = parts_of(self._contents)
        quoted = json.dumps(json.dumps(description))  # as quoted in the header, which is JSON itself
        return sum(tensor.nbytes for tensor in tensors.values()) + len(quoted)

    @property
    def nbytes(self) -> int:
        """Size of the parameters of the field, bytes: the size of the map in 3QFP."""
        return sum(p.numel() * p.element_size() for p in self.field.parameters())

    @property
    def evidence(self) -> Evidence:
        """Evidence of a surface in each leaf cell, in the order of the cells' keys."""
        return self._contents.evidence

    @property
    def field(self) -> Field:
        """Signed distance and intensity as a PyTorch module, in the local frame."""
        return self._contents.field


@torch.inference_mode(mode=False)
def _from_pickle(data: bytes, description: dict[str, Any]) -> RadarMap:
    return RadarMap(contents_of(load(data), description))


@torch.inference_mode(mode=False)  # or the map could not compute gradients
def load_contents(path: AnyPath) -> MapContents:
    """Read the file of a map. Raise a ValueError if it is damaged, of another program or of another version."""
    check_regular_file(path)
    with reading(path, "a complete radarsdf map", Exception), open_tensors(path) as file:
        check(file.metadata.get("format") == FORMAT, "it has another format")
        version, known = file.metadata.get("format_version", ""), str(FORMAT_VERSION)
        check(version == known, f"it has format version {version!r}, this radarsdf {known}: fit it again")
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
    origin, keys = _taken(tensors, {"origin": (np.float64, 3), "leaf_keys": (np.int64, None)}).values()
    evidence = _taken(tensors, {name: (dtype, len(keys)) for name, dtype in _EVIDENCE.items()})
    check((evidence["information"] >= 0).all(), "information is negative")
    free_space = FreeSpace(**_taken(tensors, _PARTS["free_space"], "free_space."))
    free_space.check()
    views = _taken(tensors, _PARTS["view_statistics"], "view_statistics.")
    view_statistics = ViewStatistics(**views, sigma=float(description["view_sigma"]))
    view_statistics.check(config.leaf_size_m)
    limits = description["intensity_scale"]
    scale = None if limits is None else IntensityScale.between(limits)
    share, reflectance = description["network_share"], None
    if share is not None:
        share = _in_range("network_share", share, 1)
        arrays = _taken(tensors, _PARTS["reflectance"], "reflectance.")
        reflectance = Reflectance(config.leaf_size_m, **arrays, network_share=share)
        reflectance.check()
    # A map with intensities needs a network or a closed form to predict them; one without has neither.
    trained = scale is not None and config.trains_intensity
    answered = trained or reflectance is not None
    check(answered == (scale is not None), "a predictor of intensities is missing or superfluous")
    field = _field_of(tensors, keys, config, trained)
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


def _taken(
    tensors: dict[str, Tensor], wanted: dict[str, tuple[Any, ...]], prefix: str = ""
) -> dict[str, Any]:
    """Pop arrays of finite numbers, by type and shape as for :func:`check_arrays`, with int64 as uint64."""
    arrays = {name: tensors.pop(f"{prefix}{name}").numpy().copy() for name in wanted}
    check_arrays(arrays, wanted)
    for name, array in arrays.items():
        check(np.isfinite(array).all(), f"{name} contains non-finite numbers")
        arrays[name] = array.view(np.uint64) if array.dtype == np.int64 else array
    return arrays


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
