"""Growth of time and memory: `python -m bench.growth fits|surfels|poses`, on Linux."""

from bench.growth import fits
from bench.runner import Experiment, main

_THREADS = {"threads": [2]}

EXPERIMENTS = {
    "fits": Experiment(
        "Fits of a street", fits.fits, (), ("returns", "sizes", "threads"),
        {"returns": [10**4, 10**5, 10**6, 10**7], "sizes": [500.0], "threads": [1, 2]}, fits.FIT_COLUMNS,
        lines=("returns", "size_m", "threads", "intensities"), plot=fits.draw_fits,
    ),
    "surfels": Experiment(
        "Ghost search and visibility counts", fits.surfels, (), ("returns", "threads"),
        {"returns": [10**5, 10**6, 10**7]} | _THREADS, fits.SURFEL_COLUMNS, lines=("returns", "threads"),
    ),
    "poses": Experiment(
        "Pose refinement", fits.poses, (), ("threads",), _THREADS, fits.POSE_COLUMNS, lines=("scans", "threads"),
    ),
}  # fmt: skip


if __name__ == "__main__":
    main("bench.growth", EXPERIMENTS)
