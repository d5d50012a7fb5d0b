# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The map that a robot grows while it drives."""

from __future__ import annotations

import dataclasses
import os
import threading
import weakref
from collections.abc import Hashable, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import (
    check_pose,
    instance,
    not_negative,
    path_of,
    positions,
    whole_number,
)
from radarsdf.config.fit_config import FitConfig
from radarsdf.live.following import Follower
from radarsdf.live.learning import finished, known_now
from radarsdf.live.rows import Keys
from radarsdf.live.scan_log import ScanId, ScanLog
from radarsdf.live.scans import Integrated, checked_scan, finite_time
from radarsdf.live.shelf import Shelf, locked_folder
from radarsdf.live.state import GrowingState
from radarsdf.live.storage import load_state, save_state
from radarsdf.returns.evidence import Looks
from radarsdf.threads import resolve_num_threads

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.radar_map import RadarMap


class LiveMap:
    """A map that grows scan by scan. Scans can be moved, and taken out again, without a trace.

    What a scan adds are integers that depend on the scan, its pose and the settings alone. So a map that a scan was taken
    out of has the bits of one that never saw it. They do not depend on the order of scans either, except for what is found
    from single returns: the noise of the sensor, if it is not given, intensities, what :meth:`finish` trains, and the order
    of scans in files. All methods may be called from any thread; those that
    change the map wait for each other, and readers see it before a change or after it.

    Parameters
    ----------
    config : FitConfig, optional
        Settings. :meth:`mesh` and :meth:`map` are those of :meth:`FitConfig.quick` with the same cells, returns, and bridges
        over gaps; :meth:`finish` fits with all of them.
    origin : (3,) array_like, optional
        Origin of the local frame, world, m. By default the first sensor position, moved to the next corner of a block of
        ``config.lattice``.
    max_bytes : int, optional
        Memory that the map may take, bytes. Beyond it, the oldest scans are let go: they stay in the map, but can no
        longer be moved or taken out. None: all are kept.
    folder : path-like, optional
        An empty or new folder, or one that a map has used before, to which scans are written instead of being let go, and
        regions of the map far away by :meth:`clear_outside`, or beyond `max_bytes`, instead of being forgotten. It is locked as
        long as the map lives.

    Raises
    ------
    ValueError
        If a setting is out of range, several scans are to be accumulated, or `folder` holds other files.
    OSError
        If `folder` cannot be written, or another map uses it.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=8)
    >>> live = radarsdf.LiveMap()
    >>> for points, pose in zip(scans.points, scans.poses):
    ...     done = live.integrate(points, pose)
    >>> len(live), live.mesh().is_empty
    (8, False)
    >>> blocks = live.remove(done.scan_id)  # as if it had never been there
    >>> len(live), len(blocks) > 0
    (7, True)
    """

    def __init__(
        self,
        config: FitConfig | None = None,
        *,
        origin: ArrayLike | None = None,
        max_bytes: int | None = None,
        folder: str | PathLike[str] | None = None,
    ) -> None:
        config = FitConfig() if config is None else instance(config, FitConfig, "config")
        if config.returns.accumulate_scans != 1:
            msg = "returns.accumulate_scans must be 1: a live map gets scans one after another"
            raise ValueError(msg)
        place = None if folder is None else path_of(folder, "folder")
        if place is not None:
            weakref.finalize(self, os.close, locked_folder(place))
        self._state = GrowingState(
            config,
            None if origin is None else positions([np.asarray(origin)], "origin")[0],
            None if max_bytes is None else whole_number(max_bytes, "max_bytes", 1),
            ScanLog(place),
            None if place is None else Shelf(place),
        )
        self._follower = Follower(config, config.num_threads)
        self._lock = threading.RLock()  # of the state
        self._reading = threading.Lock()  # of its surface, taken first

    def __len__(self) -> int:
        with self._lock:
            return len(self._state.log)

    def __repr__(self) -> str:
        with self._lock:
            cells = self._state.sums.num_cells
            return f"LiveMap({len(self)} scans, {cells} cells, {self.num_bytes / 1e6:.1f} MB)"

    @property
    def config(self) -> FitConfig:
        """Settings."""
        return self._state.config

    @property
    def origin(self) -> NDArray[np.float64] | None:
        """(3,) origin of the local frame, world, m. None: there was no scan yet."""
        return self._state.origin

    @property
    def scan_ids(self) -> list[ScanId]:
        """Of the scans that can be moved or taken out, in the order in which they came."""
        with self._lock:
            return self._state.log.ids

    @property
    def sealed_scans(self) -> int:
        """Number of scans that can no longer be moved or taken out."""
        with self._lock:
            return self._state.log.sealed

    @property
    def num_bytes(self) -> int:
        """Memory that the map takes, bytes."""
        with self._lock:  # tables that grow just now have no size
            return self._state.num_bytes

    def pose(self, scan_id: ScanId) -> NDArray[np.float64]:
        """(4, 4) T_world_sensor of a scan, m. Raises a KeyError if it cannot be taken out."""
        with self._lock:
            return self._state.log.pose(scan_id).copy()

    def integrate(
        self,
        points: ArrayLike,
        pose: ArrayLike | None = None,
        intensities: ArrayLike | None = None,
        *,
        doppler_mps: ArrayLike | None = None,
        time_s: float | None = None,
        scan_id: ScanId | None = None,
    ) -> Integrated:
        """Adds a scan.

        Without its pose, it is put where its returns agree with the last scans, near where its Doppler, or the motion so far,
        lead. The world is then the frame of the first scan. Where many scans drift, :func:`radarsdf.refine_poses` and
        :meth:`move_all` mend them.

        Parameters
        ----------
        points : (N, 3) array_like
            Returns, sensor frame, m.
        pose : (4, 4) array_like, optional
            T_world_sensor, m. Without it, the scan needs a time after that of the scan before.
        intensities : (N,) array_like, optional
            Sensor units. All scans have them, or none has.
        doppler_mps : (N,) array_like, optional
            Speed along the ray, m/s, folded or not; NaN where it was not measured. Returns that move are left out.
        time_s : float, optional
            When the scan was taken, s. Only scans without a pose need it, and those before them, to go on from.
        scan_id : hashable, optional
            By which the scan is known. By default a number that counts on.

        Raises
        ------
        ValueError
            If something is invalid, the map has a scan of this id, or a scan without a pose is late.
        Lost
            A ValueError, if a scan without a pose agrees with the last ones nowhere near. After any error, the map is as
            before.
        """
        scan = checked_scan(points, intensities, doppler_mps, self._state.config.returns)
        given = None if pose is None else check_pose(pose, "pose").copy()
        scan = dataclasses.replace(scan, time_s=None if time_s is None else finite_time(time_s))
        instance(scan_id, Hashable, "scan_id")  # type: ignore[type-abstract]
        if given is None and scan.time_s is None:
            msg = "a scan needs a pose, or a time"
            raise ValueError(msg)
        with self._lock:
            if scan_id is None:
                scan_id = self._state.next_id
            if scan_id in self._state.log:
                msg = f"the map has a scan {scan_id!r} already: remove or move it"
                raise ValueError(msg)
            with_intensities = scan.intensities is not None
            if self._state.with_intensities not in (None, with_intensities):
                msg = "either all scans have intensities, or none has"
                raise ValueError(msg)
            steps = self._follower.seek(self._state.log, scan_id, scan) if given is None else []
            come = {step.scan_id: step.logged.at(step.found.pose) for step in steps}
            scan = come[scan_id] if given is None else scan.at(given)
            again = [step.scan_id for step in steps[:-1]]
            origin = None
            if self._state.origin is None:
                lattice = self._state.config.lattice
                origin = lattice.position(lattice.nearest_block(scan.pose[:3, 3]))
            blocks = self._state.exchange(come | {scan_id: scan}, again, origin)
            self._state.with_intensities = with_intensities
            if given is None:
                self._follower.keep(steps)
            else:
                self._follower.place(scan_id, scan)
            if isinstance(scan_id, int):
                self._state.next_id = max(self._state.next_id, scan_id + 1)
        movers = 0 if scan.standing is None else int((~scan.standing).sum())
        return Integrated(scan_id, scan.pose.copy(), blocks, movers, tuple(again))

    def remove(self, scan_id: ScanId) -> Keys:
        """Takes a scan out. The map then has the bits of one that never saw it.

        Returns
        -------
        (B,) ndarray
            Keys of the blocks whose returns changed, uint64.

        Raises
        ------
        KeyError
            If there is no scan of this id.
        ValueError
            If it was let go to bound the memory.
        """
        with self._lock:
            return self._state.exchange({}, [scan_id])

    def move(self, scan_id: ScanId, pose: ArrayLike) -> Keys:
        """Moves a scan to another `pose` (4, 4). Returns and raises as :meth:`remove`."""
        return self.move_all({scan_id: pose})

    def move_all(self, poses: Mapping[ScanId, ArrayLike]) -> Keys:
        """Moves scans to other poses, (4, 4) each: after a closed loop. All of them, or none if one cannot be moved.

        Readers see the map before, or with all scans moved. Returns and raises as :meth:`remove`.
        """
        checked = {
            scan_id: check_pose(pose, f"the pose of scan {scan_id!r:.50}").copy()
            for scan_id, pose in instance(poses, Mapping, "poses").items()  # type: ignore[type-abstract]
        }
        with self._lock:
            scans = {scan_id: self._state.log.get(scan_id) for scan_id in checked}
            moved = {
                scan_id: scan.at(checked[scan_id])
                for scan_id, scan in scans.items()
                if (checked[scan_id] != scan.pose).any()
            }
            return self._state.exchange(moved, moved)

    def clear_outside(self, centre: ArrayLike, radius_m: float) -> Keys:
        """Forgets the map beyond a ball. Scans that reach beyond it can then be neither moved nor taken out.

        With a folder, nothing is forgotten: regions of 64³ leaf cells that lie beyond the ball go there, and come back, with
        the same bits, when a scan that reaches them is added, moved or taken out. Until then :meth:`mesh` is without them.

        Parameters
        ----------
        centre : (3,) array_like
            World, m.
        radius_m : float
            Blocks with their middle farther away are forgotten, or regions are put away of which all is farther away.

        Returns
        -------
        (B,) ndarray
            Keys of these blocks, uint64.
        """
        middle, radius = positions([np.asarray(centre)], "centre")[0], not_negative(radius_m, "radius_m")
        with self._lock:
            return self._state.clear_outside(middle, radius)

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the state to a file, from which :meth:`load` goes on. An old file is replaced once the new one is complete.

        Raises
        ------
        ValueError
            If an id of a scan is neither a whole number nor a string.
        OSError
            If the file cannot be written.
        """
        with self._lock, self._state.whole():
            state = self._state.stored()
        save_state(state, path)

    @classmethod
    def load(cls, path: str | PathLike[str], *, folder: str | PathLike[str] | None = None) -> LiveMap:
        """A map as it was saved. Scans without poses go on from a scan that is given with its pose and time.

        Parameters
        ----------
        path : path-like
            A file that :meth:`save` wrote.
        folder : path-like, optional
            Where scans are to be written if memory is short, as of the constructor.

        Raises
        ------
        ValueError
            If the file is none, is damaged, or comes from another version.
        OSError
            If it cannot be read.
        """
        stored = load_state(path)
        live = cls(stored.config, origin=stored.origin, max_bytes=stored.max_bytes, folder=folder)
        live._state.restore(stored)
        for scan_id, scan in stored.scans.items():
            live._follower.place(scan_id, scan)
        return live

    def mesh(self, **limits: Any) -> trimesh.Trimesh:
        """The surface as triangles, in voxels of the size of leaf cells. Only what changed is made anew.

        Parameters
        ----------
        **limits
            `min_confidence`, `max_uncertainty` and `min_component_triangles` of :meth:`Map.mesh`.

        Returns
        -------
        trimesh.Trimesh
            As of :meth:`Map.mesh`. It is empty if there is no surface.
        """
        from radarsdf.map.threshold import Limits  # noqa: PLC0415 - only a mesh needs it

        with self._reading:
            num_threads = resolve_num_threads(self._state.config.num_threads)
            with self._lock:
                surface, changes, noise = self._state.changes()
            try:
                surface.update(changes, noise, num_threads)
                found = surface.triangles()
            except BaseException:  # Ctrl-C, say: half of it would be wrong from now on
                self._state.forget_surface()
                raise
        voxel_m = found.scene.config.leaf_size_m
        return found.surface.mesh(found.scene.origin, Limits.of(voxel_m, **limits), found.leaf_cells)

    def map(self) -> RadarMap:
        """What is known now, as a map that does not grow: the quick fit of all scans, smoothed. Intensities are in closed form.

        Raises
        ------
        ValueError
            If there is no scan that could be taken out.
        """
        with self._lock, self._state.whole():
            scans, sums = list(self._state.log.scans()), self._state.all_sums()
            looks = Looks(*self._state.sums.looks_of(self._state.sums.block_keys()))
        return known_now(scans, sums, looks, self._state.quick, self._state.origin)

    def finish(self, *, progress: bool | None = None) -> RadarMap:
        """The fit of all scans with all settings, as :func:`radarsdf.fit` makes it with this `origin`.

        Raises
        ------
        ValueError
            If scans were let go, or there are none.
        """
        with self._lock:
            if self._state.log.sealed:
                msg = f"{self._state.log.sealed} scans were let go to bound the memory, so that they cannot be fitted: give the map a folder to keep scans in"
                raise ValueError(msg)
            scans = list(self._state.log.scans())
        return finished(scans, self._state.config, self._state.origin, progress)
