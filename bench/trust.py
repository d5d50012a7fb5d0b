"""Faults of Doppler and stamps: whether odometry, refinement, live maps and checks are right, marked, refused, or wrong.

    python -m bench.trust [--kinds hugin tunnel] [--faults zeros late] [--uses odometry] [--seeds 1 2 3]

Right: within 4 of its own standard deviations from the middle scan, or within 5 % of the path for poses without deviations.
"""

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.poses.rigid import aligned
from radarsdf.returns.moving import sensor_velocity
from radarsdf.simulate import Simulation, drifted, measured_motion

from scenes.kinds import KINDS

Floats = NDArray[np.float64]
FRAMES, SIGMAS, SHARE = 20, 4.0, 0.05
_SIMULATED = ("hugin", "oculii", "wall", "astyx")


@dataclass
class Told:
    """Scans with the Doppler and times that a recording states for them."""

    scans: Simulation
    doppler_mps: list[NDArray[np.float32]]
    times_s: Floats
    rng: np.random.Generator


def _scaled(told: Told, factors: Floats) -> None:
    told.doppler_mps = [
        np.float32(factor) * values for factor, values in zip(factors, told.doppler_mps, strict=True)
    ]


def _compensated(told: Told) -> None:
    noise = [0.1 * told.rng.standard_normal(len(x)) for x in told.doppler_mps]
    moving = [5 * told.rng.standard_normal(len(x)) * (told.rng.random(len(x)) < 0.1) for x in noise]
    told.doppler_mps = [(a + b).astype(np.float32) for a, b in zip(noise, moving, strict=True)]


def _offset(told: Told, mps: float) -> None:
    told.doppler_mps = [x + np.float32(mps) for x in told.doppler_mps]


def _late(told: Told) -> None:
    resampled = []
    for i, values in enumerate(told.doppler_mps):
        x = told.scans.points[i] / np.linalg.norm(told.scans.points[i], axis=1, keepdims=True)
        own, other = (
            sensor_velocity(told.scans.points[k], told.doppler_mps[k]).velocity_mps
            for k in (i, max(i - 3, 0))
        )
        resampled.append((values + x @ (own - other)).astype(np.float32))
    told.doppler_mps = resampled


def _repeated(told: Told) -> None:
    told.times_s[FRAMES // 2] = told.times_s[FRAMES // 2 - 1]


def _jitter(told: Told, sigma_s: float) -> None:
    noise = told.rng.normal(0, sigma_s, len(told.times_s)).clip(-0.045, 0.045)
    told.times_s = np.sort(told.times_s + noise)


_HALF = np.arange(FRAMES) >= FRAMES // 2
FAULTS: dict[str, Callable[[Told], None]] = {
    "good": lambda _: None,
    "compensated": _compensated,
    "doubled": lambda told: _scaled(told, np.full(FRAMES, 2.0)),
    "x1.15": lambda told: _scaled(told, np.full(FRAMES, 1.15)),
    "zeros": lambda told: _scaled(told, np.zeros(FRAMES)),
    "stuck": lambda told: setattr(
        told, "doppler_mps", [told.doppler_mps[0][np.arange(len(x)) % len(told.doppler_mps[0])] for x in told.doppler_mps]
    ),
    "sign_from_half": lambda told: _scaled(told, np.where(_HALF, -1.0, 1.0)),
    "zero_from_half": lambda told: _scaled(told, np.where(_HALF, 0.0, 1.0)),
    "scaled_from_half": lambda told: _scaled(told, np.where(_HALF, 1.3, 1.0)),
    "drifting": lambda told: _scaled(told, np.linspace(1.0, 1.5, FRAMES)),
    "offset_0.5": lambda told: _offset(told, 0.5),
    "offset_1.5": lambda told: _offset(told, 1.5),
    "late": _late,
    "repeated_stamp": _repeated,
    "jitter_12ms": lambda told: _jitter(told, 0.012),
    "jitter_40ms": lambda told: _jitter(told, 0.04),
}  # fmt: skip


def errors_m(poses: Floats, true: Floats) -> Floats:
    """Position errors (F,) after one rigid motion."""
    return np.asarray(np.linalg.norm(aligned(poses, true)[:, :3, 3] - true[:, :3, 3], axis=1))


def _odometry(told: Told) -> str:
    try:
        found = radarsdf.odometry(
            told.scans.points, doppler_mps=told.doppler_mps, times_s=told.times_s, progress=False
        )
    except ValueError:
        return "refused"
    rows = found.longest_segment()
    poses, true = found.poses[rows], told.scans.poses[rows]
    if len(poses) < 3:
        return "refused"
    middle = found.covariance[rows][:, :3, :3].trace(axis1=1, axis2=2).argmin()
    moved, truly = (np.linalg.inv(p[middle]) @ p for p in (poses, true))
    error_m = np.linalg.norm(moved[:, :3, 3] - truly[:, :3, 3], axis=1)
    sigma_m = np.sqrt(found.covariance[rows][:, :3, :3].trace(axis1=1, axis2=2))
    worst = float((error_m / np.maximum(sigma_m, 1e-3)).max())
    marked = bool(found.report["notes"]) or found.report["segments"] > 1
    verdict = "right" if worst < SIGMAS else "marked" if marked else "WRONG"
    if verdict == "right" and marked:
        verdict = "noted"
    return f"{verdict} {worst:.1f}s {np.sqrt((errors_m(poses, true) ** 2).mean()):.2f}m"


def _refine(told: Told) -> str:
    given = drifted(told.scans.poses, 0.02, 0.002, seed=1)
    found = radarsdf.refine_poses(
        told.scans.points, given, doppler_mps=told.doppler_mps, times_s=told.times_s, progress=False
    )
    plain = radarsdf.refine_poses(told.scans.points, given, progress=False)
    before, after, without = (
        float(np.sqrt((errors_m(p, told.scans.poses) ** 2).mean())) for p in (given, found.poses, plain.poses)
    )
    marked, fine = bool(found.report["notes"]), after < max(1.5 * without, without + 0.01)
    kept = not found.improved  # which its verdict and its covariance say
    verdict = ("noted" if marked else "right") if fine else "marked" if marked or kept else "WRONG"
    return f"{verdict} {before:.2f}>{after:.2f} ({without:.2f}) m"


def _live(told: Told) -> str:
    live, placed, lost = radarsdf.LiveMap(), [], 0
    notes: tuple[str, ...] = ()
    for i in range(FRAMES):
        try:
            done = live.integrate(
                told.scans.points[i], time_s=float(told.times_s[i]), doppler_mps=told.doppler_mps[i]
            )
        except ValueError:
            lost += 1
            continue
        placed.append((i, done.scan_id))
        notes = done.notes
    if len(placed) < 3:
        return f"refused ({lost} lost)"
    poses = np.stack([live.pose(scan_id) for _, scan_id in placed])
    rows = [i for i, _ in placed]
    error = float(errors_m(poses, told.scans.poses[rows]).max())
    length = float(np.linalg.norm(np.diff(told.scans.poses[rows, :3, 3], axis=0), axis=1).sum())
    fine = error < max(0.3, SHARE * length)
    marked = lost > 0 or len(notes) > 0
    verdict = ("noted" if marked else "right") if fine else "marked" if marked else "WRONG"
    return f"{verdict} {error:.2f}m of {length:.0f}, {lost} lost"


def _check(told: Told) -> str:
    found = radarsdf.check(
        told.scans.points, told.scans.poses, doppler_mps=told.doppler_mps, times_s=told.times_s
    )
    names = sorted({one.name for one in found if one.severity != "note"})
    notes = sorted({one.name for one in found if one.severity == "note"})
    return f"{'marked' if names else 'none'} {','.join(names)} | {','.join(notes)}"


USES: dict[str, Callable[[Told], str]] = {
    "odometry": _odometry,
    "refine": _refine,
    "live": _live,
    "check": _check,
}


def main() -> None:
    """Print one line a case, and counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    # The stations of `facade` are 9 to 18 m apart, and the scans at their ends 0.1 s: no Doppler agrees with such a leap.
    kinds = [*_SIMULATED, *(kind for kind in KINDS if kind != "facade")]
    parser.add_argument("--kinds", nargs="+", default=kinds, choices=kinds)
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--uses", nargs="+", default=list(USES), choices=list(USES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    wanted = parser.parse_args()
    counts: Counter[tuple[str, str, str]] = Counter()
    for kind, seed in itertools.product(wanted.kinds, wanted.seeds):
        make = KINDS[kind] if kind in KINDS else getattr(radarsdf.simulate, kind)
        scans = make(seed=seed, frames=FRAMES)
        motion = measured_motion(scans, seed=seed)
        for fault, use in itertools.product(wanted.faults, wanted.uses):
            told = Told(scans, list(motion.doppler_mps), motion.times_s.copy(), np.random.default_rng(seed))
            FAULTS[fault](told)
            begin = time.process_time()
            result = USES[use](told)
            counts[use, fault, result.split()[0]] += 1
            print(
                f"{kind:9} {seed:3} {fault:16} {use:8} {time.process_time() - begin:5.1f} s  {result}",
                flush=True,
            )
    for use, fault in itertools.product(wanted.uses, wanted.faults):
        print(use, fault, {name: n for (u, f, name), n in sorted(counts.items()) if (u, f) == (use, fault)})


if __name__ == "__main__":
    main()
