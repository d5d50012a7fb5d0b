"""Live maps: `python -m bench.live EXPERIMENT`."""

from bench.live import accuracy, removal, speed
from bench.runner import Experiment, main

_OPTIONS = ("seed", "threads")
_SCENES = ("hugin", "oculii", "wall")

EXPERIMENTS = {
    "rates": Experiment(
        "Time of a scan and of a mesh", speed.rates, (*_SCENES, "astyx", speed.DENSE), _OPTIONS
    ),
    "growth": Experiment("A mesh after one more scan, on small and large maps", speed.growth, (), _OPTIONS),
    "circles": Experiment("Memory over very many scans", speed.circles, ("100000",), _OPTIONS),
    "tracking": Experiment("Odometry of scans of 2,000 returns", speed.tracking, _SCENES[:2], _OPTIONS),
    "accuracy": Experiment("Surface after each tenth of a drive", accuracy.accuracy, _SCENES, _OPTIONS),
    "intensities": Experiment("Intensities of held-out scans", accuracy.intensities, _SCENES[:2], _OPTIONS),
    "loops": Experiment(
        "Closed loops of tracked scans", accuracy.loops, ("yard", "hall", "car_park"), _OPTIONS
    ),
    "removal": Experiment("Removed and moved scans", removal.removal, _SCENES[:2], _OPTIONS),
}


if __name__ == "__main__":
    main("bench.live", EXPERIMENTS)
