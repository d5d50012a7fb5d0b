# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a user can name is in features.txt: a name that goes is seen here, one that comes is written there.

``python -m tests.test_features`` writes the file.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

import pytest
import radarsdf
from radarsdf import FitConfig, evaluation, io, simulate
from radarsdf.cli import tiles, whole_parser
from radarsdf.io.bags.files import BAG_SUFFIXES
from radarsdf.io.bags.messages import CLOUD_TYPES, POSE_TYPES, TRANSFORM_TYPES
from radarsdf.io.clouds.fields import DIALECTS
from radarsdf.io.clouds.reading import CLOUD_SUFFIXES
from radarsdf.io.clouds.writing import CLOUD_OUT_SUFFIXES
from radarsdf.io.datasets.published import DATASETS
from radarsdf.io.meshes import MESH_SUFFIXES
from radarsdf.io.poses.reading import POSE_FILES

FILE = Path(__file__).with_name("features.txt")


def features():
    """A line for each name, sorted."""
    for package in (radarsdf, evaluation, io, simulate):
        yield from (f"name {package.__name__}.{name}" for name in package.__all__)
    for kind in documented_classes():
        fields = getattr(kind, "__dataclass_fields__", ())  # those without a default are no attributes
        yield from (
            f"name {kind.__name__}.{name}" for name in {*dir(kind), *fields} if not name.startswith("_")
        )
    for group, settings in FitConfig().to_dict().items():
        own = settings if isinstance(settings, dict) else {"": None}
        yield from (f"setting {group}.{name}".removesuffix(".") for name in own)
    yield from options("", whole_parser())
    for step in tiles.STEPS:
        parser = argparse.ArgumentParser()
        tiles.add_step_arguments(parser, step)
        yield from options(f" tiles {step}", parser)
    yield from (f"reads {suffix}" for suffix in (*CLOUD_SUFFIXES, *BAG_SUFFIXES, *POSE_FILES))
    yield from (f"reads {message}" for message in (*CLOUD_TYPES, *POSE_TYPES, *TRANSFORM_TYPES))
    yield from (f"reads {type(dataset).__name__}" for dataset in DATASETS)
    yield from (f"reads {dialect.name}" for dialect in DIALECTS)
    yield from (f"writes {suffix}" for suffix in (*CLOUD_OUT_SUFFIXES, *MESH_SUFFIXES))


def documented_classes():
    """The classes that the reference of docs/api shows."""
    for page in sorted((FILE.parents[1] / "docs" / "api").glob("*.md")):
        module = "radarsdf"
        for line in page.read_text(encoding="utf-8").splitlines():
            directive, _, name = line.partition(":: ")
            if directive in (".. module", ".. currentmodule", ".. automodule"):
                module = name
            elif directive == ".. autoclass":
                yield getattr(importlib.import_module(module), name.partition("(")[0])


def options(command, parser):
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from options(f"{command} {name}", inner)
        else:
            yield f"radarsdf{command} {'/'.join(action.option_strings) or action.dest.upper()}"


def lines():
    return sorted(set(features()))


def test_no_feature_goes_and_none_comes_unnamed():
    assert lines() == FILE.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize(
    ("command", "suffixes"),
    [
        ("eval", (*CLOUD_SUFFIXES, *MESH_SUFFIXES)),
        ("convert", (*CLOUD_OUT_SUFFIXES, *MESH_SUFFIXES)),
    ],
)
def test_helps_name_all_formats(command, suffixes):
    (commands,) = (a for a in whole_parser()._actions if isinstance(a, argparse._SubParsersAction))
    text = commands.choices[command].format_help()
    assert [suffix for suffix in suffixes if suffix not in text] == []


def test_the_page_of_files_names_all_that_are_read():
    text = (FILE.parents[1] / "docs" / "your_own_scans.md").read_text(encoding="utf-8")
    assert [suffix for suffix in (*CLOUD_SUFFIXES, *BAG_SUFFIXES) if f"`{suffix}`" not in text] == []


if __name__ == "__main__":
    FILE.write_text("\n".join(lines()) + "\n", encoding="utf-8")
