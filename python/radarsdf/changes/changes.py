"""Comparison of two maps of one place, or of a map with new scans, as coloured surfaces."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from radarsdf.arrays import ArrayLike, Bytes, Floats, Floats32, Ints32, NDArray
from radarsdf.changes.alignment import Alignment, align
from radarsdf.changes.probability import Differences, Errors, PlacedMap, Side, posterior, share_of_changes
from radarsdf.checks import AnyPath, check, check_box, instance, path_of
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import mesh_components
from radarsdf.fitting.fit import fit
from radarsdf.grids.occupancy import check_free_space
from radarsdf.io.meshes import write_mesh
from radarsdf.map.map import Map
from radarsdf.map.mesh import across_triangles, renumbered
from radarsdf.products import transformed
from radarsdf.scans import Scans

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
_PROBABLE = 0.5  # more likely than not
_LEVEL = np.cos(np.pi / 4)  # smallest cosine between a level surface's normal and the vertical
# Larger shares of changed surface mean that the maps do not fit together: 16 % and more where one was rotated by 20° or
# more, or shifted by 20 m, on yard, hall, forest, car_park and facade. A car that moved on open ground is less.
_MOST_CHANGED = 0.1
_AGREEING_SIGMAS = 3.0


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
        """List the connected components of changes of one kind and surface, of at least `min_area_m2`, m², largest first."""
        found = []
        for surface in (self.before, self.after):
            of_faces, areas = surface.of_faces()
            for kind in CHANGED:
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

    def mesh(self) -> trimesh.Trimesh:
        """Combine the later surface with the faces of the earlier one that are gone or moved, with colours.

        The mesh is in the world of the earlier map, m. Green: appeared, vermilion: gone, orange: moved, purple: changed
        reflectance, grey: same, light grey: unseen. Its ``vertex_attributes`` (V,) are `kind`, `probability`, `moved_m` and
        `intensity_change` of :class:`ChangedSurface`.
        """
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


def compare(
    before: Map,
    after: Map | Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    align_frames: bool = True,
    box: ArrayLike | None = None,
    progress: bool | None = None,
) -> Changes:
    """Detect what appeared, disappeared, moved or changed its reflectance between two maps of one place.

    Unseen is not gone: a surface is gone only if rays of the later drive crossed its place, and it appeared only if rays
    of the earlier drive did. The probability of a change follows from the distance between the surfaces and its standard
    error, from the numbers of scans that hit and crossed the place in each drive, from the confidence of the changed
    surface, and from intensities of equal views. The share of changes is estimated from all places together.

    Parameters
    ----------
    before : Map
        The earlier map, fitted with ``returns.free_space``, which is the default of :class:`FitConfig`.
    after : Map, iterable of F arrays, or Scans
        The later map, fitted in the same way; or new scans as :func:`fit` takes them, which are first fitted with
        ``FitConfig.quick()`` and with the ranges, pose errors and leaf cells of `before`.
    poses : (F, 4, 4) array_like, optional
        For new scans: T_world_sensor, m.
    intensities : iterable of F arrays (N_i,), optional
        For new scans: sensor units.
    align_frames : bool
        Whether to align the later map as a whole, if its surface shows an offset between the frames at a significance
        level of 0.001. Offsets may be some metres and some degrees, and any where the later map fits in one place alone, as
        :func:`locate` would find it. Along axes that the surfaces do not determine, such as along a single wall, the frame is kept.
    box : (2, 3) array_like, optional
        Lower and upper corner, world of the earlier map, m: nothing outside is returned.
    progress : bool, optional
        Whether to show the progress of a fit of new scans. Default: only on a terminal.

    Returns
    -------
    Changes
        Surfaces of both maps, in the world of the earlier one, with kinds and probabilities of changes.

    Raises
    ------
    ValueError
        If a map has no free-space crossings (``returns.free_space``) or no surface, for wrong arguments, or if the maps do not
        fit together: they have no surface in common, or more of their common level or steep surfaces would have changed
        than agrees.
    TypeError
        If `before` is not a map.

    Notes
    -----
    An object that stood on the ground is "moved" where its top was about parallel to the ground and within two leaf cells of it.
    Intensities near surface that appeared, disappeared or moved are left out.
    """
    instance(before, Map, "before")  # type: ignore[type-abstract]
    corners = None if box is None else check_box(box)
    check_free_space(before, "before")
    if not isinstance(after, Map):
        own, names = before.config, ("min_range_m", "max_range_m", "pose_sigma_m", "pose_sigma_rad")
        returns = {"free_space": True} | {name: getattr(own.returns, name) for name in names}
        limits = {"num_threads": own.num_threads, "max_memory_bytes": own.max_memory_bytes}
        config = FitConfig.quick(leaf_size_m=own.leaf_size_m, returns=returns, **limits)
        after = fit(after, poses, intensities, config=config, progress=progress)
    else:
        given = poses is not None or intensities is not None
        check(not given, "poses and intensities belong to new scans: a map has its own")
    check_free_space(after, "after")
    earlier, later = PlacedMap.of(before), PlacedMap.of(after)
    for name, found in (("before", earlier), ("after", later)):
        check(len(found.faces) != 0, f"{name} has no surface: fit it with more scans of the place")
    alignment = align(earlier, later) if align_frames else Alignment()
    later = replace(later, T_common_map=alignment.T_before_after)
    sides = _side(earlier, later, alignment), _side(later, earlier, alignment)
    errors = Errors.of(sides)
    odds = [errors.log_odds(side) for side in sides]
    share = share_of_changes(np.concatenate([region for *_, region in odds]))
    gone = _classify(sides[0], odds[0], share, GONE)
    appeared = _classify(sides[1], odds[1], share, APPEARED)
    _check_common(sides, [gone.kind, appeared.kind], errors, alignment.words)
    differences = Differences.of(earlier, later)
    offset, words = None, differences
    if isinstance(differences, Differences):
        changed = np.concatenate([surface.vertices[surface.kind > SAME] for surface in (gone, appeared)])
        change, of_change = differences.probability(appeared.vertices, appeared.kind == SAME, changed)
        appeared = replace(
            appeared,
            kind=np.where(of_change > _PROBABLE, REFLECTANCE_CHANGED, appeared.kind).astype(np.int8),
            probability=np.maximum(appeared.probability, of_change.astype(np.float32)),
            intensity_change=change.astype(np.float32),
        )
        offset = differences.offset
        words = f"All returns of the later drive are {offset:+.1f} stronger, sensor units."
    if corners is not None:
        gone, appeared = _crop(corners, gone), _crop(corners, appeared)
    report = {"alignment": alignment.words, "intensity_offset": offset, "reflectance": words}
    return Changes(gone, appeared, alignment.T_before_after, report | areas_of(gone, appeared))


def _side(own_map: PlacedMap, other_map: PlacedMap, alignment: Alignment) -> Side:
    vertices = transformed(own_map.vertices, own_map.T_common_map)
    own = own_map.evidence(vertices)
    other = other_map.evidence(vertices, own.normals)
    sigma_m = np.hypot(np.hypot(own.sigma_m, alignment.sigma_m(vertices, own.normals)), other.sigma_m)
    return Side(vertices, own_map.faces, own, other, sigma_m, other_map.reach_m)


def _classify(side: Side, odds: tuple[Floats, Floats, Floats], share: float, lost: int) -> ChangedSurface:
    """Assign kinds, probabilities, displacements by :meth:`Errors.log_odds`. `lost`: kind of surface missing from the other map."""
    (absent, shifted, region), own, other = odds, side.own, side.other
    # Within a region from which something is absent, each place is as probably part of it as not.
    gone = own.confidence * posterior(region, share) * posterior(absent, 0.5)
    elsewhere = own.confidence * posterior(shifted, share)
    moved = np.where(side.parallel, other.confidence * elsewhere, 0.0)
    seen = np.isfinite(other.distance_m)
    behind = seen & (other.distance_m < 0)
    kinds = np.where(seen, SAME, UNSEEN).astype(np.int8)
    # Places deep behind the other surface are hidden by it.
    kinds[behind & ~side.parallel & (elsewhere > _PROBABLE)] = UNSEEN
    kinds[~behind & (gone > _PROBABLE)] = lost
    # A displaced surface is a stronger claim than a missing one. In front of the other surface, rays must have crossed, too.
    kinds[(moved > _PROBABLE) & (behind | (seen & (gone > _PROBABLE)))] = MOVED
    probability = np.where(kinds == MOVED, np.maximum(moved, np.where(behind, 0, gone)), gone)
    # Displacement along the normal, from the earlier to the later surface.
    towards = -other.distance_m if lost == GONE else other.distance_m
    moved_m = np.where(kinds == MOVED, towards, np.nan).astype(np.float32)
    unknown = np.full(len(kinds), np.nan, np.float32)
    return ChangedSurface(side.vertices, side.faces, kinds, probability.astype(np.float32), moved_m, unknown)


def _crop(box: Floats, surface: ChangedSurface) -> ChangedSurface:
    within = ((surface.vertices >= box[0]) & (surface.vertices <= box[1])).all(axis=1)
    used, faces = renumbered(len(within), surface.faces[within[surface.faces].all(axis=1)])
    of_vertices = {name: values[used] for name, values in vars(surface).items() if name != "faces"}
    return ChangedSurface(faces=faces, **of_vertices)


def _check_common(
    sides: Sequence[Side], kinds: Sequence[NDArray[np.int8]], errors: Errors, words: str
) -> None:
    # Maps in wrong frames still agree about the ground and level floors, so level and steep surfaces are tested separately;
    # and on both sides, since a place may have been cleared.
    seen = sum(int((of_side != UNSEEN).sum()) for of_side in kinds)
    check(seen, f"the maps have no surface in common: they are of other places, or in other frames. {words}")
    for name, is_level in (("level", True), ("steep", False)):
        changed, agree = np.zeros(2), np.zeros(2)
        for i, (side, of_side) in enumerate(zip(sides, kinds, strict=True)):
            mask = (np.abs(side.own.normals[:, 2]) >= _LEVEL) == is_level
            limit_m = _AGREEING_SIGMAS * errors.scale * side.sigma_m
            alike = side.parallel & (np.abs(side.other.distance_m) <= limit_m) & (of_side == SAME)
            changed[i], agree[i] = (mask & (of_side > SAME)).sum(), (mask & alike).sum()
        if changed.sum() > _MOST_CHANGED * seen and (changed > agree).all():
            shares = " and ".join(f"{part:.0%}" for part in changed / (changed + agree))
            msg = (
                f"the maps do not fit together: of the {name} surfaces that both observed, {shares} would have changed. "
                f"Give maps of one place, in about one frame. {words}"
            )
            raise ValueError(msg)
