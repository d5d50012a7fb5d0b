"""Comparison of two maps of one place, or of a map with new scans."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.arrays import Floats
from radarsdf.changes.alignment import Alignment, align
from radarsdf.changes.changes import (
    APPEARED,
    GONE,
    MOVED,
    REFLECTANCE_CHANGED,
    SAME,
    UNSEEN,
    ChangedSurface,
    Changes,
    areas_of,
)  # fmt: skip
from radarsdf.changes.probability import Differences, Errors, PlacedMap, Side, posterior, share_of_changes
from radarsdf.checks import check, check_box, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.fit import fit
from radarsdf.grids.occupancy import check_free_space
from radarsdf.map.map import Map
from radarsdf.map.mesh import renumbered
from radarsdf.scans import Scans

_PROBABLE = 0.5  # more likely than not
_LEVEL = np.cos(np.pi / 4)  # smallest cosine between a level surface's normal and the vertical
# Larger shares of changed surface mean that the maps do not fit together: 16 % and more where one was rotated by 20° or
# more, or shifted by 20 m, on yard, hall, forest, car_park and facade. A car that moved on open ground is less.
_MOST_CHANGED = 0.1
_AGREEING_SIGMAS = 3.0


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
        names = ("min_range_m", "max_range_m", "pose_sigma_m", "pose_sigma_rad")
        config = FitConfig.quick(
            leaf_size_m=before.config.leaf_size_m,
            num_threads=before.config.num_threads,
            max_memory_bytes=before.config.max_memory_bytes,
            returns={"free_space": True} | {name: getattr(before.config.returns, name) for name in names},
        )
        after = fit(after, poses, intensities, config=config, progress=progress)
    elif poses is not None or intensities is not None:
        msg = "poses and intensities belong to new scans: a map has its own"
        raise ValueError(msg)
    check_free_space(after, "after")
    placed = PlacedMap.of(before), PlacedMap.of(after)
    for name, found in zip(("before", "after"), placed, strict=True):
        check(len(found.faces) != 0, f"{name} has no surface: fit it with more scans of the place")
    earlier, later = placed
    alignment = align(earlier, later) if align_frames else Alignment()
    later = replace(later, T_common_map=alignment.T_before_after)
    sides = _side(earlier, later, alignment), _side(later, earlier, alignment)
    errors = Errors.of(sides)
    odds = [errors.log_odds(side) for side in sides]
    share = share_of_changes(np.concatenate([region for *_, region in odds]))
    gone = _classify(sides[0], odds[0], share, GONE)
    appeared = _classify(sides[1], odds[1], share, APPEARED)
    _check_common(sides, [gone.kind, appeared.kind], errors, alignment)
    differences = Differences.of(earlier, later)
    offset, words = None, differences
    if isinstance(differences, Differences):
        changed = np.concatenate([surface.vertices[surface.kind > SAME] for surface in (gone, appeared)])
        same = appeared.kind == SAME
        change, of_change = differences.probability(appeared.vertices, same, changed)
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
    vertices = own_map.to_common(own_map.vertices)
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
    sides: Sequence[Side], kinds: Sequence[NDArray[np.int8]], errors: Errors, alignment: Alignment
) -> None:
    # Maps in wrong frames still agree about the ground and level floors, so level and steep surfaces are tested separately;
    # and on both sides, since a place may have been cleared.
    seen = sum(int((of_side != UNSEEN).sum()) for of_side in kinds)
    if seen == 0:
        msg = f"the maps have no surface in common: they are of other places, or in other frames. {alignment.words}"
        raise ValueError(msg)
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
                f"Give maps of one place, in about one frame. {alignment.words}"
            )
            raise ValueError(msg)
