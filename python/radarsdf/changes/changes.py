"""Result of a comparison of two maps, as coloured surfaces."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.arrays import Bytes, Floats, Floats32, Ints32
from radarsdf.checks import AnyPath, path_of
from radarsdf.map.marching_cubes import mesh_components
from radarsdf.map.threshold import across_triangles

if TYPE_CHECKING:
    import trimesh


UNSEEN, SAME, GONE, APPEARED, MOVED, REFLECTANCE_CHANGED = -1, 0, 1, 2, 3, 4
NAMES = {
    UNSEEN: "unseen", SAME: "same", GONE: "gone", APPEARED: "appeared", MOVED: "moved", REFLECTANCE_CHANGED: "reflectance_changed",
}  # fmt: skip
CHANGED = (APPEARED, GONE, MOVED, REFLECTANCE_CHANGED)
# Distinguishable by colour-blind people, too (Okabe and Ito 2008).
COLORS = {
    UNSEEN: (225, 225, 225), SAME: (165, 165, 165), GONE: (213, 94, 0), APPEARED: (0, 158, 115),
    MOVED: (230, 159, 0), REFLECTANCE_CHANGED: (204, 121, 167),
}  # fmt: skip


@dataclass(frozen=True)
class ChangedSurface:
    """Surface of one map with its differences from the other."""

    vertices: Floats
    """(V, 3) world of the earlier map, m."""
    faces: Ints32
    """(F, 3) rows of vertices; triangles face free space."""
    kind: NDArray[np.int8]
    """(V,) -1 unseen, 0 same, 1 gone, 2 appeared, 3 moved, 4 changed reflectance. Unseen: not observed by the other map.
    Changed reflectance, on the later surface only: the surface did not move."""
    probability: Floats32
    """(V,) probability of that change; of the likeliest change where it is the same or unseen."""
    moved_m: Floats32
    """(V,) displacement along the normal towards free space, m. NaN for other kinds."""
    intensity_change: Floats32
    """(V,) later minus earlier intensity from views common to both drives, sensor units, without the offset common to all
    places. NaN without such views."""

    def of_faces(self) -> tuple[NDArray[np.int8], Floats]:
        """Return kinds (F,) int8 of the faces, by majority of the vertices or that of the first, and areas (F,), m²."""
        kinds = self.kind[self.faces]
        _, twice_m2 = across_triangles(self.vertices, self.faces)
        return np.where(kinds[:, 1] == kinds[:, 2], kinds[:, 1], kinds[:, 0]), 0.5 * twice_m2


@dataclass(frozen=True)
class Region:
    """A connected component of faces of one kind of change."""

    kind: str
    """``appeared``, ``gone``, ``moved`` or ``reflectance_changed``."""
    box: Floats
    """(2, 3) lower and upper corner, world of the earlier map, m."""
    area_m2: float
    """Area, m²."""
    probability: float
    """Mean probability of its vertices."""
    moved_m: float | None
    """Mean displacement along the normal, m. None for other changes."""
    intensity_change: float | None
    """Mean of later minus earlier intensity, sensor units. None for other changes."""

    @property
    def words(self) -> str:
        """Description of the change, such as "moved by 0.21 m"."""
        if self.moved_m is not None:
            return f"{self.kind} by {abs(self.moved_m):.2f} m"
        if self.intensity_change is not None:
            stronger = "stronger" if self.intensity_change > 0 else "weaker"
            return f"{self.kind}, {abs(self.intensity_change):.1f} {stronger}"
        return self.kind


@dataclass(frozen=True)
class Changes:
    """Result of :func:`radarsdf.compare`."""

    before: ChangedSurface
    """The earlier surface, with what disappeared or moved."""
    after: ChangedSurface
    """The later surface, with what appeared, moved or changed its reflectance."""
    T_before_after: Floats
    """(4, 4) transform from the later map's world to that of the earlier one, m."""
    report: dict[str, Any]
    """`alignment`: verdict in words; `areas_m2` by kind; `compared_m2`, area of surface observed by both maps; `reflectance`:
    common offset of intensities in words, or why they were not compared; `intensity_offset`, sensor units, or None."""

    def regions(self, min_area_m2: float = 0.0) -> list[Region]:
        """List the connected components of changes of at least `min_area_m2`, m², largest first.

        Each consists of faces of one kind, on one of the two surfaces.
        """
        found = []
        for surface, kinds in (
            (self.before, (GONE, MOVED)),
            (self.after, (APPEARED, MOVED, REFLECTANCE_CHANGED)),
        ):
            of_faces, areas = surface.of_faces()
            for kind in kinds:
                rows = np.flatnonzero(of_faces == kind)
                labels, sizes = mesh_components(surface.faces[rows], len(surface.vertices))
                ends = np.cumsum(sizes)[:-1]
                for faces in np.split(rows[np.argsort(labels, kind="stable")], ends) if len(rows) else []:
                    vertices = np.unique(surface.faces[faces])
                    x = surface.vertices[vertices]
                    region = Region(
                        NAMES[kind],
                        np.stack([x.min(axis=0), x.max(axis=0)]),
                        float(areas[faces].sum()),
                        float(surface.probability[vertices].mean()),
                        _mean(surface.moved_m[vertices]) if kind == MOVED else None,
                        _mean(surface.intensity_change[vertices]) if kind == REFLECTANCE_CHANGED else None,
                    )
                    if region.area_m2 >= min_area_m2:
                        found.append(region)
        return sorted(found, key=lambda region: -region.area_m2)

    def mesh(self) -> "trimesh.Trimesh":
        """Combine the later surface with the faces of the earlier one that are gone or moved, with colours.

        The mesh is in the world of the earlier map, m. Green: appeared, vermilion: gone, orange: moved, purple: changed
        reflectance, grey: same, light grey: unseen. Its ``vertex_attributes`` (V,) are `kind`, `probability`, `moved_m` and
        `intensity_change` of :class:`ChangedSurface`.
        """
        import trimesh  # noqa: PLC0415 - slow to import

        from radarsdf.map.mesh import renumbered  # noqa: PLC0415 - it imports trimesh

        of_faces, _ = self.before.of_faces()
        lost = self.before.faces[(of_faces == GONE) | (of_faces == MOVED)]
        used, lost = renumbered(len(self.before.vertices), lost)
        vertices = np.concatenate([self.after.vertices, self.before.vertices[used]])
        faces = np.concatenate([self.after.faces, lost + np.int32(len(self.after.vertices))])
        mesh: Any = trimesh.Trimesh(vertices, faces, process=False)
        for name in ("kind", "probability", "moved_m", "intensity_change"):
            after, before = (getattr(side, name) for side in (self.after, self.before))
            mesh.vertex_attributes[name] = np.concatenate([after, before[used]])
        mesh.visual.vertex_colors = colors_of(mesh.vertex_attributes["kind"])
        return mesh

    def save(self, path: AnyPath) -> None:
        """Write the mesh of :meth:`mesh` by :func:`radarsdf.io.write_mesh`, with its formats and errors."""
        from radarsdf.io.meshes import write_mesh  # noqa: PLC0415 - as above

        write_mesh(path_of(path, "path"), self.mesh())


def areas_of(*surfaces: ChangedSurface) -> dict[str, Any]:
    kinds, areas_m2 = (np.concatenate(of) for of in zip(*(s.of_faces() for s in surfaces), strict=True))
    of_kinds = {NAMES[kind]: float(areas_m2[kinds == kind].sum()) for kind in CHANGED}
    return {"areas_m2": of_kinds, "compared_m2": float(areas_m2[kinds != UNSEEN].sum())}


def colors_of(kinds: NDArray[np.int8]) -> Bytes:
    """Colours (V, 3), sRGB, of kinds (V,)."""
    table = np.array([COLORS[kind] for kind in sorted(COLORS)], np.uint8)
    return table[np.asarray(kinds, np.int64) - min(COLORS)]


def _mean(values: Floats32) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
