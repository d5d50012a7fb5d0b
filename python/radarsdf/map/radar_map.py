"""The map that a fit returns, stored in one file."""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors.torch import load, save

from radarsdf.arrays import Array, Bools, Floats
from radarsdf.checks import AnyPath
from radarsdf.field.field import Field
from radarsdf.map import queries, storage
from radarsdf.map.confidence import CellsInBox, EvidenceAt, dense_cells, evidence
from radarsdf.map.map import Map, Query
from radarsdf.map.queries import MapContents
from radarsdf.returns.evidence import Evidence
from radarsdf.returns.sums import lattice_of
from radarsdf.returns.view_statistics import ViewStatisticsAt

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.view import ViewedMap


class RadarMap(Map):
    """Fitted map in one file, created by :func:`radarsdf.fit` or :func:`radarsdf.load`. See :class:`Map` for its queries."""

    def __init__(self, contents: MapContents) -> None:
        self._contents = contents

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return f"RadarMap({kind}, {self.num_cells} cells, {self.file_bytes / 1e6:.1f} MB)"

    def __reduce__(self) -> "tuple[Callable[..., RadarMap], tuple[Any, ...]]":
        tensors, description = storage.parts_of(self._contents)
        return _from_pickle, (save(tensors), description)  # bytes: the pickle needs no classes of PyTorch

    def _evaluate(self, query: Query, world: Floats, *others: Floats, extrapolate: bool) -> Array:
        points, *rest = (queries.to_local(self._contents, x) for x in (world, *others))
        inside = queries.into_cells(self._contents, points)
        known: Any = np.isfinite(points).all(axis=1) if extrapolate else inside
        for x in rest:
            known = known & np.isfinite(x).all(axis=1)
        return queries.where(known, query, self._contents, points, *rest)

    def _observed(self, world: Floats) -> Bools:
        return queries.into_cells(self._contents, queries.to_local(self._contents, world))

    @property
    def contents_of_any(self) -> MapContents:
        return self._contents

    def _surface_mesh(self, voxel_size: float, **wanted: Any) -> "trimesh.Trimesh":
        from radarsdf.map.mesh import extract_mesh  # noqa: PLC0415 - trimesh is slow to import

        return extract_mesh(self._contents, voxel_size, **wanted)

    def cells_near(self, lower: Floats, upper: Floats) -> CellsInBox:
        leaf_m = self.config.leaf_size_m
        first = np.floor((lower - self.origin) / leaf_m).astype(np.int64)
        count = np.floor((upper - self.origin) / leaf_m).astype(np.int64) - first + 1
        x, y, z = count.tolist()
        cells = dense_cells(self._contents, first, (x, y, z))
        return CellsInBox(self.origin + first * leaf_m, *cells)

    def evidence_at(self, world: Floats) -> EvidenceAt:
        return evidence(self._contents, queries.to_local(self._contents, world))

    def view_statistics(self) -> ViewStatisticsAt:
        return self._contents.views_in_world()

    def _viewed_from(self, position: Floats, range_m: float) -> "ViewedMap":  # noqa: ARG002 - the whole map
        return self._viewed

    @cached_property
    def _viewed(self) -> "ViewedMap":
        from radarsdf.map.view import ViewedMap  # noqa: PLC0415 - trimesh is slow to import

        return ViewedMap.of(self._contents)

    def save(self, path: AnyPath) -> None:
        storage.save_contents(self._contents, path)

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
        return storage.file_bytes(self._contents)

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
    return RadarMap(storage.contents_of(load(data), description))
