"""Settings are validated at construction, with errors of one line, and saved without loss."""

import copy
import dataclasses
import json
import math
import pickle
import re
import sys

import numpy as np
import pytest
from pydantic import ValidationError
from radarsdf import FitConfig, _core
from radarsdf.config import groups
from radarsdf.config.fit_config import flat_settings
from radarsdf.settings import first_wrong

TINY, LARGE = sys.float_info.min, 1e300
MAX_COUNT, MAX_SAMPLES, MAX_WIDTH = 2**31 - 1, 2**24, 4096

# Of each setting, the least and the greatest value that pass, and what is refused below and above: None, where any larger
# finite number passes.
WHOLE = {
    "seed": (0, 2**48, -1, 2**48 + 1),
    "num_threads": (0, 1024, -1, 1025),
    "max_memory_bytes": (1, 2**63 - 1, 0, 2**63),
    "returns.accumulate_scans": (1, MAX_COUNT, 0, MAX_COUNT + 1),
    "encoding.bridge_cells": (0, 8, -1, 9),
    "encoding.fourier_count": (0, 24, -1, 25),
    "networks.geometry_feature_dim": (0, MAX_WIDTH, -1, MAX_WIDTH + 1),
    "training.batch_size": (1, MAX_SAMPLES, 0, MAX_SAMPLES + 1),
    "training.intensity_batch_size": (1, MAX_SAMPLES, 0, MAX_SAMPLES + 1),
    "training.sdf_iterations": (1, MAX_COUNT, -3, MAX_COUNT + 1),
    "training.intensity_iterations": (1, MAX_COUNT, 0, MAX_COUNT + 1),
}
REAL = {
    "leaf_size_m": (TINY, 1e6, 0.0, 1.1e6),
    "effort": (TINY, 1000.0, 0.0, 1000.1),
    "returns.min_range_m": (0.0, LARGE, -0.1, None),
    "returns.max_range_m": (2.6, LARGE, 2.5, None),  # of which the default's least range is the limit
    "returns.range_noise_m": (TINY, 100.0, 0.0, 100.1),
    "returns.azimuth_noise_rad": (TINY, 1.0, 0.0, 1.1),
    "returns.elevation_noise_rad": (TINY, 1.0, 0.0, 1.1),
    "returns.pose_sigma_m": (0.0, 100.0, -0.1, 100.1),
    "returns.pose_sigma_rad": (0.0, 1.0, -0.1, 1.1),
    "training.cross_range_noise_rad": (0.0, LARGE, -0.1, None),
    "training.sigma_cells": (TINY, LARGE, 0.0, None),
    "training.learning_rate": (TINY, LARGE, 0.0, None),
    "training.intensity_learning_rate": (TINY, LARGE, 0.0, None),
}
TRUTH = [
    "train",
    *(f"returns.{name}" for name in ("drop_moving", "drop_ghosts", "free_space", "onto_planes")),
    *(f"networks.{name}" for name in ("dropout", "normals", "view_direction", "log_range")),
    "training.intensity_in_free_space",
]
WORDS = {
    "encoding.kind": ["tri-quadtree", "octree"],
    "training.optimiser": ["soap", "adam"],
    "networks.reflectance": ["network", "closed-form", "both"],
}
WIDTHS = "networks.intensity_hidden"


def nested(name, value):
    """A setting such as "training.batch_size" as arguments of FitConfig."""
    group, dot, own = name.partition(".")
    return {group: {own: value}} if dot else {group: value}


def get(config, name):
    for part in name.split("."):
        config = getattr(config, part)
    return config


def refused(name, value, says=r"."):
    """Rejected by constructor, override and file, with the name of the setting."""
    base = FitConfig()
    for make in (FitConfig, base.override, lambda **values: FitConfig.from_dict(values)):
        with pytest.raises(ValidationError) as caught:
            make(**nested(name, value))
        message = first_wrong(caught.value)
        assert message.startswith(f"{name} must"), message
        assert re.search(says, message)


NAMES = list(flat_settings(FitConfig().to_dict()))


def test_every_setting_is_in_one_of_these_tests():
    assert sorted([*WHOLE, *REAL, *TRUTH, *WORDS, WIDTHS]) == sorted(NAMES)


@pytest.mark.parametrize(
    ("name", "least", "greatest", "below", "above"), [(n, *v) for n, v in (WHOLE | REAL).items()]
)
def test_ranges(name, least, greatest, below, above):
    for value in (least, greatest):
        assert get(FitConfig(**nested(name, value)), name) == value
    refused(name, below, says=f"not {below}")
    if above is not None:
        refused(name, above, says=f"not {above}")
    if name in REAL:
        for value in (math.nan, math.inf, -math.inf):
            refused(name, value)


@pytest.mark.parametrize("name", NAMES)
def test_types(name):
    wrong = [b"1", [1.5], {}, (), object(), 1j]
    if name in WHOLE:
        wrong += [True, 1.0, "1", np.float64(1)]
    elif name in REAL:
        wrong += [True, "0.5"]
    elif name in TRUTH:
        wrong += [1, 0, "yes", 1.0]
    elif name in WORDS:
        wrong += ["", "zero", 1, True]
    for value in wrong:
        refused(name, value)
    for value in WORDS.get(name, ()):
        assert get(FitConfig(**nested(name, value)), name) == value


def test_widths():
    for value in ((1,), (MAX_WIDTH,) * 32, [3, 4]):
        found = get(FitConfig(**nested(WIDTHS, value)), WIDTHS)
        assert found == tuple(value)
        assert isinstance(found, tuple)
    for value in ((), (0,), (MAX_WIDTH + 1,), (8,) * 33, (True,), (1.0,), ("8",), "88", 8, {8: 8}, ((8,),)):
        refused(WIDTHS, value)


def test_limits_are_those_of_the_core():
    assert groups.MAX_FREQUENCIES == _core.MAX_FREQUENCIES


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"training": {"joint": True}}, "unknown setting training.joint"),  # of older versions
        ({"sdf_iterations": 1}, "unknown setting sdf_iterations"),
        ({"returns": {"max_range_m": 1.0}}, "returns.max_range_m must exceed min_range_m, 2.5, not 1.0"),
    ],
)
def test_messages(values, message):
    for make in (FitConfig, FitConfig().override, lambda **settings: FitConfig.from_dict(settings)):
        with pytest.raises(ValidationError) as caught:
            make(**values)
        assert first_wrong(caught.value) == message


def test_override_changes_only_the_named_settings():
    base = FitConfig.paper(seed=3, training={"sdf_iterations": 200}, networks={"normals": False})
    changed = base.override(leaf_size_m=0.3, training={"batch_size": 77}, returns={"drop_ghosts": True})
    differing = {name for name in NAMES if get(base, name) != get(changed, name)}
    assert differing == {"leaf_size_m", "training.batch_size", "returns.drop_ghosts"}
    assert (changed.seed, changed.training.sdf_iterations, changed.networks.normals) == (3, 200, False)
    assert base.training.batch_size == 8192
    assert base.override() == base
    # A group as a whole replaces the whole.
    assert base.override(training=FitConfig().training).training == FitConfig().training
    # None is a value.
    assert base.override(training={"sdf_iterations": None}).training.sdf_iterations is None
    # Settings are checked together.
    near = FitConfig(returns={"max_range_m": 3.0})
    with pytest.raises(ValueError, match="must exceed"):
        near.override(returns={"min_range_m": 3.0})
    assert near.override(returns={"min_range_m": 3.0, "max_range_m": None}).returns.min_range_m == 3.0


CONFIGS = {
    "default": FitConfig(),
    "quick": FitConfig.quick(),
    "paper": FitConfig.paper(),
    "changed": FitConfig(seed=9, max_memory_bytes=10**12, networks={"intensity_hidden": [3, 4]}),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_to_dict_and_from_dict_are_inverse(config):
    values = config.to_dict()
    assert FitConfig.from_dict(values) == config
    assert FitConfig.from_dict(json.loads(json.dumps(values))) == config  # JSON has no tuples
    values["training"]["batch_size"] = 1
    assert config.training.batch_size != 1  # a copy
    for other in (pickle.loads(pickle.dumps(config)), copy.deepcopy(config), dataclasses.replace(config)):
        assert other == config
        assert hash(other) == hash(config)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.training.batch_size = 1


def test_from_dict_fills_what_is_missing():
    found = FitConfig.from_dict({"seed": 2, "networks": {"dropout": False}})
    assert found == FitConfig(seed=2, networks={"dropout": False}) != FitConfig()


def test_lengths_scale_with_the_cells():
    assert (FitConfig().sigma_m, FitConfig(leaf_size_m=0.4).sigma_m) == (0.1, 0.2)
    assert FitConfig().metres(1.5) == 0.3  # not 0.30000000000000004


PUBLISHED = {
    "returns.accumulate_scans": 5,
    "returns.drop_moving": False,
    "returns.drop_ghosts": False,
    "returns.free_space": False,
    "returns.onto_planes": False,
    "encoding.bridge_cells": 0,
    "encoding.fourier_count": 16,
    "networks.intensity_hidden": (64, 64),
    "networks.geometry_feature_dim": 15,
    "networks.reflectance": "network",
    "networks.normals": True,
    "networks.log_range": False,
    "networks.dropout": False,
    "training.cross_range_noise_rad": 0.0,
    "training.sigma_cells": 0.1375,
    "training.intensity_in_free_space": True,
    "training.batch_size": 8192,
    "training.intensity_batch_size": 8192,
    "training.sdf_iterations": 1000,
    "training.intensity_iterations": 4000,
    "training.optimiser": "adam",
    "training.learning_rate": 1e-3,
    "training.intensity_learning_rate": 1e-3,
}


def test_presets():
    default, paper = (flat_settings(config.to_dict()) for config in (FitConfig(), FitConfig.paper()))
    assert {name: value for name, value in paper.items() if value != default[name]} == PUBLISHED
    quick = FitConfig.quick(seed=4)
    assert (quick.train, quick.seed, quick.returns.free_space) == (False, 4, False)
    assert quick.override(train=True, seed=0, returns={"free_space": True}) == FitConfig()
    assert quick.closes_intensity
    assert not quick.trains_intensity
    assert FitConfig().trains_intensity
