"""Experiments of the paper, and ours of the same kind: `python -m bench.paper EXPERIMENT [SCENE ...]`."""

from radarsdf.simulate import SCENES

from bench.paper import calibration, poses, reflectance, surface
from bench.peers.interface import PEERS
from bench.runner import Column, Experiment, main
from scenes.kinds import KINDS

_SCENES = ("hugin", "oculii", "wall")
_ALL = ("seed", "frames", "box")
_SURFACE = (*_ALL, "samples", "peers")
_PEERS = {"peers": list(PEERS)}
_DEFAULT = {"base": ["default"]}

EXPERIMENTS = {
    "surface": Experiment(
        "Surface quality (Table I)", surface.surface, _SCENES, (*_SURFACE, "meshes"), _PEERS, surface.COLUMNS, ("scene",)
    ),
    "sparse": Experiment(
        "Completion with every n-th scan", surface.sparse, _SCENES[:2], (*_SURFACE, "meshes"), _PEERS,
        {key: surface.COLUMNS[key] for key in ("completion_ratio", "outlier_ratio")}, ("scene",), across="n",
    ),
    "ranges": Experiment(
        "Precision and completion by range", surface.ranges, _SCENES, _SURFACE, _PEERS, surface.RANGE_COLUMNS, ("scene",),
        across="range",
    ),
    "map-size": Experiment(
        "Map size over the number of scans", surface.map_size, _SCENES, _ALL, {}, surface.SIZE_COLUMNS, ("scene",),
        across="scans",
    ),
    "curve": Experiment(
        "Run time against error", surface.curve, _SCENES, (*_SURFACE, "repetitions", "set", "meshes"),
        _PEERS | {"repetitions": 3}, surface.COLUMNS, ("scene",), median=True, plot=surface.draw_curve,
    ),
    "seeds": Experiment(
        "Variation with the seed", surface.seeds, _SCENES[:1], (*_ALL, "samples", "repetitions"), {"repetitions": 10},
        {key: Column(surface.COLUMNS[key].heading, surface.COLUMNS[key].factor) for key in ("f_score", "f_score_all", "mae")},
        lines=("scene",),
    ),
    "intensity": Experiment(
        "Held-out intensity (Table II)", reflectance.intensity, _SCENES, (*_ALL, "base", "repetitions"),
        {"repetitions": 10}, reflectance.INTENSITY_COLUMNS, ("scene",),
    ),
    "ablation": Experiment(
        "Inputs of the intensity network (Table III)", reflectance.ablation, ("wall",), (*_ALL, "base", "repetitions"),
        {"base": ["paper"], "repetitions": 10}, reflectance.INTENSITY_COLUMNS, ("scene", "base"), ("variant",),
    ),
    "views": Experiment(
        "View-dependent intensity of the corner reflector", reflectance.views, ("wall",), (*_ALL, "base"), {},
        reflectance.VIEW_COLUMNS, ("scene", "place"), ("base", "view direction", "against"),
    ),
    "novel-views": Experiment(
        "Held-out scans: predicted, and replayed", reflectance.novel_views, (*_SCENES, "astyx"), (*_ALL, "base", "meshes"),
        _DEFAULT, reflectance.SCAN_COLUMNS, ("scene", "base"),
    ),
    "calibration": Experiment(
        "Uncertainty and confidence against the truth", calibration.calibration, _SCENES,
        (*_ALL, "samples", "base", "repetitions", "set"), _DEFAULT, calibration.COLUMNS, ("scene", "part"),
        ("base", "variant", "bin"),
    ),
    "kinds": Experiment(
        "Kinds of scenes", calibration.kinds, (*SCENES, *KINDS), (*_SURFACE, "repetitions", "meshes"),
        {"peers": list(calibration.KINDS_PEERS)}, calibration.KINDS_COLUMNS, ("part",), ("scene",), across="method",
        mean_line=True,
    ),
    "poses": Experiment(
        "Refined poses, and poses from the radar alone", poses.poses, tuple(SCENES),
        (*_ALL, "samples", "repetitions"), {"repetitions": 10}, poses.COLUMNS, ("scene",), ("poses",),
    ),
}  # fmt: skip


if __name__ == "__main__":
    main("bench.paper", EXPERIMENTS)
