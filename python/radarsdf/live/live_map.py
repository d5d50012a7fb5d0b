"""Incremental map of a driving robot."""

import os
import threading
import weakref
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from radarsdf import checks
from radarsdf.arrays import ArrayLike, Floats, Keys, Mesh
from radarsdf.checks import AnyPath, check, check_pose, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.fit import fit, fit_rays
from radarsdf.live.state import GrowingState
from radarsdf.live.store import LoggedScan, ScanId, compact, load_state, locked_folder
from radarsdf.live.surface import NO_KEYS
from radarsdf.live.tracking import Elsewhere, Follower
from radarsdf.map.radar_map import RadarMap
from radarsdf.map.threshold import Limits
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.locate import locate
from radarsdf.poses.loops import visits
from radarsdf.poses.refine import refine_poses
from radarsdf.poses.search import SUBMAP_SCANS, Lost, SurfaceIndex
from radarsdf.returns.moving import moving_returns
from radarsdf.returns.rays import check_scans
from radarsdf.rig import Label, Mounted, checked_mountings
from radarsdf.scans import Scans, all_or_nan, all_or_none

_MOST_UNPLACED = 10 * SUBMAP_SCANS  # lost scans to search the map for
_RANGED = 100  # scans from which the median range is known


@dataclass(frozen=True)
class Integrated:
    """Result of the integration of a scan."""

    scan_id: ScanId
    """Identifier to move or remove the scan."""
    pose: Floats
    """(4, 4) T_world_sensor, m."""
    blocks: Keys
    """(B,) ascending keys of the changed blocks of 8 × 8 × 8 leaf cells."""
    moving: int
    """Number of moving returns, which are left out."""
    moved: tuple[ScanId, ...] = ()
    """Earlier scans with re-estimated poses, since the motion was not observable before; see :meth:`LiveMap.pose`."""
    far: int = 0
    """Number of returns at more than 100 times the median range, such as sentinels, which are left out."""
    notes: tuple[str, ...] = ()
    """What the pose of a tracked scan assumes of the Doppler, which the returns so far neither confirm nor contradict."""


class LiveMap:
    """Incremental map. Scans can be added, moved and removed exactly.

    Parameters
    ----------
    config : FitConfig, optional
        Settings. :meth:`mesh` and :meth:`map` use those of :meth:`FitConfig.quick` with the same cells, returns, and bridges
        over gaps; :meth:`finish` uses all of them.
    origin : (3,) array_like, optional
        Origin of the local frame, world, m. Default: the block corner of ``config.lattice`` nearest to the first sensor.
    max_bytes : int, optional
        Memory limit, bytes, above which the oldest scans are sealed: they stay in the map, but can no longer be moved or
        removed. Default: no limit; with a folder, all scans are written there.
    folder : path-like, optional
        An empty, new or previously used folder, to which scans are written instead of being sealed, so that the memory does
        not grow with their number, and regions instead of being discarded by :meth:`clear_outside`. It is locked during the
        lifetime of the map.
    T_body_sensor : mapping, optional
        Mounting (4, 4) of each radar of a rig by its label, m. Poses are then T_world_body.

    Raises
    ------
    ValueError
        If a setting is out of range, ``returns.accumulate_scans`` is not 1, or `folder` contains other files.
    OSError
        If `folder` cannot be written, or another map uses it.

    Notes
    -----
    A scan adds integers that depend on the scan, its pose and the settings alone. So after a removal, the map is bit-identical
    to one that never saw the scan, in any order. Estimated noise of the sensor, the result of :meth:`finish`, and files depend
    on the order of scans. Intensities depend on the origin.

    All methods are thread-safe, and changes are atomic: after any error, the map is as before; after Ctrl-C or another
    asynchronous exception, a change is either complete or absent. A map belongs to the process that created it: in one forked
    from it, methods that change the map or may use its folder raise a RuntimeError. Poses are T_world_sensor, m.
    Methods that change the map return the ascending keys (B,), uint64, of the changed blocks of 8 × 8 × 8 leaf cells.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=8)
    >>> live = radarsdf.LiveMap()
    >>> for points, pose in zip(scans.points, scans.poses):
    ...     done = live.integrate(points, pose)
    >>> len(live), live.mesh().is_empty
    (8, False)
    >>> blocks = live.remove(done.scan_id)  # as if it had never been added
    >>> len(live), len(blocks) > 0
    (7, True)
    """

    def __init__(
        self,
        config: FitConfig | None = None,
        *,
        origin: ArrayLike | None = None,
        max_bytes: int | None = None,
        folder: AnyPath | None = None,
        T_body_sensor: Mapping[Any, ArrayLike] | None = None,
    ) -> None:
        config = FitConfig() if config is None else instance(config, FitConfig, "config")
        single = config.returns.accumulate_scans == 1
        check(single, "returns.accumulate_scans must be 1: a live map integrates single scans")
        corner = None if origin is None else checks.positions([np.asarray(origin)], "origin")[0]
        most = None if max_bytes is None else checks.whole_number(max_bytes, "max_bytes", 1)
        place = None if folder is None else checks.path_of(folder, "folder")
        if place is not None:
            unlock = weakref.finalize(self, os.close, locked_folder(place))
            if hasattr(os, "register_at_fork"):  # a child process would hold the lock, too
                os.register_at_fork(after_in_child=unlock)
        mountings = None if T_body_sensor is None else checked_mountings(T_body_sensor)
        self._state = GrowingState(config, corner, most, place, mountings)
        self._follower = Follower(config, num_radars=max(len(mountings or ()), 1))
        self._unplaced: list[tuple[ScanId | None, LoggedScan]] = []  # last scans since tracking was lost
        self._index: tuple[int, SurfaceIndex] | None = None  # of the state of the map of this number
        self._pid = os.getpid()
        self._lock = threading.RLock()  # guards the state
        self._reading = threading.Lock()  # guards its surface; acquired first

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
    def origin(self) -> Floats | None:
        """(3,) origin of the local frame, world, m. None before the first scan."""
        return self._state.origin

    @property
    def scan_ids(self) -> list[ScanId]:
        """Identifiers of the scans that can be moved or removed, in order of insertion."""
        with self._lock:
            return self._state.log.ids

    @property
    def sealed_scans(self) -> int:
        """Number of scans that can no longer be moved or removed."""
        with self._lock:
            return len(self._state.log.sealed)

    @property
    def num_bytes(self) -> int:
        """Memory of the map, bytes."""
        with self._lock:  # tables must not grow meanwhile
            return self._state.num_bytes

    def _owned(self, *, changes: bool = True) -> threading.RLock:
        """Return the lock, for changes or use of the folder. Raise a RuntimeError in another process than the map's."""
        if os.getpid() != self._pid and (changes or self._state.log.folder is not None):
            msg = f"the map belongs to process {self._pid}, not to {os.getpid()}, which was forked from it: use it there, or load a saved one"
            raise RuntimeError(msg)
        return self._lock

    def pose(self, scan_id: ScanId) -> Floats:
        """Return the pose of a scan, (4, 4) float64.

        Raises
        ------
        KeyError
            If there is no such scan, or it was sealed.
        """
        with self._lock:
            found = self._state.log.placed(scan_id)
            if found is None:
                raise KeyError(scan_id)
            return found.pose.copy()

    def trajectory(self) -> tuple[Floats, Floats]:
        """Return the times (F,), s, NaN where unknown, and the poses (F, 4, 4) of the scans of :attr:`scan_ids`."""
        with self._owned(changes=False):
            known = self._state.log.trajectory()
        times_s = np.array([placed.time_s for placed in known], np.float64)  # NaN for None
        return times_s, np.array([placed.pose for placed in known]).reshape(-1, 4, 4)

    def integrate(
        self,
        points: ArrayLike,
        pose: ArrayLike | None = None,
        intensities: ArrayLike | None = None,
        *,
        doppler_mps: ArrayLike | None = None,
        time_s: float | None = None,
        scan_id: ScanId | None = None,
        sensor: Label | None = None,
        sigmas: ArrayLike | None = None,
    ) -> Integrated:
        """Add a scan of N returns.

        Without a pose, it is registered with the last scans, near the pose predicted by its Doppler or the motion so far. The
        world is then the frame of the first scan. If it agrees nowhere near, as the first scan after :meth:`load`, it is Lost,
        until every twelfth such scan is found by a search of the whole map, as in :func:`radarsdf.locate`; with it, those before
        are added. :meth:`close_loops` corrects drift of the poses.

        Parameters
        ----------
        points : (N, 3) array_like
            Returns, sensor frame, m.
        pose : (4, 4) array_like, optional
            T_world_sensor, m. Without it, the scan needs a time after that of the previous scan.
        intensities : (N,) array_like, optional
            Sensor units, for all scans or none.
        doppler_mps : (N,) array_like, optional
            Radial speed, m/s, aliased or not; NaN where it was not measured. Moving returns are left out.
        time_s : float, optional
            Time of the scan, s. Required for scans without a pose, and for the scans before them.
        scan_id : hashable, optional
            Identifier of the scan; with a folder, a string or an integer of 64 bits. Default: a consecutive number.
        sensor : hashable, optional
            Label of its radar in `T_body_sensor`. Required in the map of a rig, whose radars may measure at the same time.
        sigmas : (N, 3) array_like, optional
            Deviations of range, azimuth and elevation that the sensor states, m, rad, rad. Returns are weighted by them, relative
            to the medians of their scan. :meth:`finish` also tests them, as :func:`radarsdf.fit`.

        Returns
        -------
        Integrated
            Pose of the scan, and changed blocks.

        Raises
        ------
        ValueError
            If an argument is invalid, the map has a scan of this id, or a scan without a pose is out of order.
        Lost
            If a scan without a pose cannot be registered with the last ones; a ValueError.
        """
        scan, far = self._check(points, intensities, doppler_mps, time_s, sigmas)
        mountings = self._state.mountings
        known = sensor is None if mountings is None else sensor in mountings
        check(known, f"sensor must be one of T_body_sensor, {list(mountings or ())}, not {sensor!r:.50}")
        if mountings is not None:
            scan = replace(scan, radar=Mounted(sensor, mountings[sensor]))
        given = None if pose is None else check_pose(pose, "pose").copy()
        instance(scan_id, Hashable, "scan_id")  # type: ignore[type-abstract]
        if self._state.log.folder is not None:
            storable = type(scan_id) in (type(None), str) or (type(scan_id) is int and abs(scan_id) < 2**63)
            wanted = "with a folder, scan_id must be a string or an integer of 64 bits"
            check(storable, f"{wanted}, not {scan_id!r:.50}")
        check(given is not None or scan.time_s is not None, "a scan needs a pose, or a time")
        try:
            found = self._integrate(scan, given, scan_id, far)
        except Elsewhere as lost:
            if len(self._unplaced) == _MOST_UNPLACED:
                del self._unplaced[:SUBMAP_SCANS]
            self._unplaced.append((scan_id, scan))
            *earlier, (scan, pose, scan_id) = self._find_again(lost)
            for before, at, before_id in earlier:
                self._integrate(before, at, before_id, 0)
            found = self._integrate(scan, pose, scan_id, far)
        self._unplaced.clear()
        return found

    def _find_again(self, lost: Lost) -> list[tuple[LoggedScan, Floats, ScanId | None]]:
        """Search the map for the scans since tracking was lost; return them with poses and ids. Raise `lost` until they are found."""
        scans = [scan for _, scan in self._unplaced]
        if len(scans) % SUBMAP_SCANS or len(self) == 0:
            raise lost
        number, times_s = self._state.number, np.array([scan.time_s for scan in scans])
        drive = self._drive(scans, np.full((len(scans), 4, 4), np.nan), times_s=times_s)
        try:
            if self._index is None or self._index[0] != number:
                self._index = number, SurfaceIndex.of_mesh(self.mesh(), self.config.leaf_size_m)
            found = locate(self._index[1], drive, config=self.config, progress=False)
        except ValueError as why:
            raise lost from why
        rows = np.flatnonzero((found.segments == found.segments[-1]) & (found.segments >= 0))
        if len(rows) == 0:
            raise lost
        return [(replace(scans[i], tracked=True), found.poses[i], self._unplaced[i][0]) for i in rows]

    def _integrate(
        self, scan: LoggedScan, given: Floats | None, scan_id: ScanId | None, far: int
    ) -> Integrated:
        state = self._state
        with self._owned():
            scan_id = state.next_id if scan_id is None else scan_id
            check(scan_id not in state.log, f"the map has a scan {scan_id!r} already: remove or move it")
            with_intensities = scan.intensities is not None
            alike = state.with_intensities in (None, with_intensities)
            check(alike, "either all scans have intensities, or none has")
            steps = [] if given is not None else self._follower.seek(state.track, state.log, scan_id, scan)
            placed = {step.scan_id: replace(step.logged, pose=step.found.pose) for step in steps}
            if given is not None:
                placed[scan_id] = replace(scan, pose=given)
            scan, moved = placed[scan_id], tuple(step.scan_id for step in steps[:-1])
            lattice, origin = self.config.lattice, state.origin
            if origin is None:
                origin = lattice.position(lattice.nearest_block(scan.pose[:3, 3]))
            blocks = state.exchange(
                placed,
                moved,
                origin=origin,
                with_intensities=with_intensities,
                next_id=max(state.next_id, scan_id + 1) if isinstance(scan_id, int) else state.next_id,
                track=self._follower.track(steps) if steps else state.track.placed(scan_id, scan),
            )
            notes = self._follower.doubts(steps[-1]) if steps else ()
        moving = 0 if scan.is_static is None else int((~scan.is_static).sum())
        return Integrated(scan_id, scan.pose.copy(), blocks, moving, moved, far, notes)

    def remove(self, scan_id: ScanId) -> Keys:
        """Remove a scan. The map is then bit-identical to one that never saw it.

        Raises
        ------
        KeyError
            If there is no scan of this id.
        ValueError
            If it was sealed by `max_bytes` or :meth:`clear_outside`.
        """
        with self._owned():
            return self._state.exchange({}, [scan_id])

    def move(self, scan_id: ScanId, pose: ArrayLike) -> Keys:
        """Move a scan to another pose (4, 4). Raises the exceptions of :meth:`remove`."""
        return self.move_all({scan_id: pose})

    def move_all(self, poses: Mapping[ScanId, ArrayLike]) -> Keys:
        """Move scans to other `poses` (4, 4), by their ids, atomically, as after a loop closure.

        Raises the exceptions of :meth:`remove`, and a ValueError for an invalid pose.
        """
        instance(poses, Mapping, "poses")  # type: ignore[type-abstract]
        with self._owned():
            moved = {}
            for scan_id, given in poses.items():
                pose = check_pose(given, f"the pose of scan {scan_id!r:.50}")
                scan = self._state.log.get(scan_id)
                if (pose != scan.pose).any():
                    moved[scan_id] = replace(scan, pose=pose.copy(), tracked=False)
            return self._state.exchange(moved, moved)

    def close_loops(self) -> Keys:
        """Refine the poses of tracked scans where places are revisited, as :func:`radarsdf.refine_poses`, and move the scans to them.

        Given poses, and that of the first scan, are kept. Tracked scans that are integrated meanwhile move rigidly with the last
        refined one. Nothing changes if no place is revisited, if held-out returns do not agree better, or if scans are moved or
        removed meanwhile.

        Raises
        ------
        ValueError, OSError
            If scans were sealed, or cannot be read from the folder.
        """
        with self._owned():
            self._check_unsealed()
            log = self._state.log
            timed = [placed for placed in log.trajectory() if placed.time_s is not None]
            if not any(placed.tracked for placed in timed):
                return NO_KEYS
            ids, given, times_s, tracked = zip(*sorted(timed, key=attrgetter("time_s")), strict=True)
            some, poses = ids[:: 1 + len(ids) // _RANGED], np.stack(given)
            range_m = median_range_m([log.get(scan_id).static.points for scan_id in some])
            if not any(visits(range_m, poses)):
                return NO_KEYS
            drive = self._drive([*map(log.get, ids)], poses, times_s=np.array(times_s))
        fixed = np.arange(len(ids)) == 0 if all(tracked) else ~np.array(tracked)
        refined = refine_poses(drive, fixed=fixed, config=self.config, progress=False)
        last = np.flatnonzero(~fixed)[-1]
        T = refined.poses[last] @ np.linalg.inv(poses[last])
        with self._owned():
            now = self._state.log
            if not refined.improved or now.edits != log.edits:
                return NO_KEYS
            known = dict(zip(ids, refined.poses, strict=True))
            drifted = [placed for placed in now.trajectory() if placed.tracked]
            moved = {placed.scan_id: known.get(placed.scan_id, T @ placed.pose) for placed in drifted}
            replaced = {k: replace(now.get(k), pose=pose) for k, pose in moved.items()}
            return self._state.exchange(replaced, replaced)

    def clear_outside(self, centre: ArrayLike, radius_m: float) -> Keys:
        """Discard the map outside a ball. Scans that extend beyond it can no longer be moved or removed.

        With a folder, nothing is discarded: regions of 64³ leaf cells outside the ball are written there, and restored
        bit-identically when a scan that reaches them is added, moved or removed. Until then they are not in :meth:`mesh`.

        Blocks are discarded if their centre is more than `radius_m` from `centre` (3,), world, m; regions are written if they are
        entirely farther away.

        Raises
        ------
        ValueError, OSError
            If an argument is out of range, or a region cannot be written to the folder.
        """
        middle = checks.positions([np.asarray(centre)], "centre")[0]
        radius = checks.not_negative(radius_m, "radius_m")
        with self._owned():
            return self._state.clear_outside(middle, radius)

    def save(self, path: AnyPath) -> None:
        """Write the state to an ``.npz`` file for :meth:`load`. An existing file is replaced atomically.

        Raises
        ------
        ValueError, OSError
            If a scan id is neither an integer nor a string, or the file cannot be written.
        """
        with self._owned(changes=False), self._state.whole():
            self._state.save(path)

    @classmethod
    def load(cls, path: AnyPath, *, folder: AnyPath | None = None) -> "LiveMap":
        """Read a map written by :meth:`save`, with its settings, bit-identically. Tracking resumes from the last scans with times.

        `folder`: see the constructor.

        Raises
        ------
        ValueError
            If the file is not a live map, is damaged, or of another version, or `folder` contains other files.
        OSError
            If it cannot be read, or another map uses `folder`.
        """
        described, scans, sums = load_state(path)
        live = cls(
            FitConfig.from_dict(described.config),
            origin=described.origin,
            max_bytes=described.max_bytes,
            folder=folder,
            T_body_sensor=described.T_body_sensor,
        )
        live._state.restore(described, scans, sums)
        for scan_id, scan in zip(described.ids, scans, strict=True):
            live._state.track = live._state.track.placed(scan_id, scan)
        return live

    def mesh(self, **limits: Any) -> Mesh:
        """Extract the surface as triangles, world frame, m, in voxels of the size of leaf cells; none if there is no surface.

        Only changed distances are recomputed. `limits` are `min_confidence`, `max_uncertainty` and `min_component_triangles` of
        :meth:`Map.mesh`, which also lists the errors.
        """
        wanted = Limits.of(self.config.leaf_size_m, **limits)
        with self._reading:
            with self._owned(changes=False):
                growing, changes, visibility = self._state.changes()
            growing.update(*changes)
            growing.complete = True
            scene, surface = growing.surface(visibility)
        return surface.mesh(scene.origin, wanted, surface.cells_searched)

    def map(self) -> RadarMap:
        """Fit a map to all scans that are not sealed, by :meth:`FitConfig.quick`, with closed-form intensities.

        Raises
        ------
        ValueError, OSError
            If there is no such scan, or files in the folder cannot be read.
        """
        with self._owned(changes=False), self._state.whole():
            read = self._state.fit_input()
        return fit_rays(read, self._state.quick, progress=False)

    def finish(self, *, progress: bool | None = None) -> RadarMap:
        """Fit a map to all scans with all settings, like :func:`radarsdf.fit` with this `origin` and `progress`.

        Raises
        ------
        ValueError
            If scans were sealed, or there are none.
        """
        with self._owned(changes=False):
            self._check_unsealed()
            scans, origin = self._state.scans(), self._state.origin
        poses = np.stack([scan.pose for scan in scans])
        drive = self._drive(scans, poses, intensities=all_or_none([scan.intensities for scan in scans]))
        return fit(drive, config=self.config, progress=progress, origin=origin)

    def _check_unsealed(self) -> None:
        sealed = f"{self.sealed_scans} scans were sealed by max_bytes or clear_outside"
        check(not self.sealed_scans, f"{sealed}: give the map a folder to keep scans in")

    def _drive(self, scans: list[LoggedScan], poses: Floats, **known: Any) -> Scans:
        return Scans(
            [scan.points for scan in scans],
            poses,
            doppler_mps=all_or_none([scan.doppler_mps for scan in scans]),
            sigmas=all_or_nan([scan.sigmas for scan in scans], [scan.points for scan in scans]),
            sensors=None if self._state.mountings is None else [scan.label for scan in scans],
            T_body_sensor=self._state.mountings,
            **known,
        )

    def _check(
        self,
        points: ArrayLike,
        intensities: ArrayLike | None,
        doppler_mps: ArrayLike | None,
        time_s: float | None,
        sigmas: ArrayLike | None,
    ) -> tuple[LoggedScan, int]:
        """Check a scan, without a pose yet, and count returns too far away. Raise a ValueError if it is invalid."""
        scans, values, left_out = check_scans([points], None if intensities is None else [intensities])
        scan = scans[0].copy()
        speeds, static = None, None
        if doppler_mps is not None:
            speeds = compact(checks.real_array(doppler_mps, "doppler_mps"))
            checks.check_values_of_scan(speeds, scan, "doppler_mps", 0)
            if self.config.returns.drop_moving:
                moving = moving_returns([scan], [speeds])[0][0]
                static = ~moving if moving.any() else None
        if time_s is not None:
            time_s, latest = checks.number(time_s, "time_s"), checks.MAX_TIME_S
            check(abs(time_s) <= latest, f"time_s must be finite and within {latest:g} s, not {time_s:g}")
        values_of_scan = None if values is None else values[0].copy()
        stated = None
        if sigmas is not None:
            (stated,) = checks.values_of_scans([sigmas], scans, "sigmas", checks.real_array, 3)
            stated = compact(stated.copy())
        held = compact(scan), values_of_scan, speeds, stated, static
        return LoggedScan(np.eye(4), *held, time_s), left_out.far
