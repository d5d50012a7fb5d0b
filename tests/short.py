"""Short fits and drives for pages, which test text and files, not quality."""

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import radarsdf
from radarsdf.checking import frames
from radarsdf.fitting.estimate import Schedule
from radarsdf.render import picture

from .poses.drift import first, thinned

# Number of scans, and the step between kept returns: enough to determine the axes of an IMU.
_SCANS = {"hugin": (12, 2), "oculii": (84, 4)}


def shorten(set_attribute: Callable[[Any, str, Any], None]) -> None:
    """A tenth of the training, the first scans of simulated drives, a quarter of the pairs in checks, small pictures."""
    usual = Schedule.of

    def short(*given, **named):
        found = usual(*given, **named)
        names = ("sdf_iterations", "joint_iterations", "intensity_iterations")
        return dataclasses.replace(found, **{name: min(getattr(found, name), 30) for name in names})

    set_attribute(Schedule, "of", short)
    usual_picture = picture.save_picture

    def small(*given, **named):
        usual_picture(*given, **named | {"width": 160, "height": 100})

    set_attribute(picture, "save_picture", small)
    set_attribute(frames, "FULL", dataclasses.replace(frames.FULL, pairs=12))
    for name, (scans, every) in _SCANS.items():
        set_attribute(radarsdf.simulate, name, _begun(getattr(radarsdf.simulate, name), scans, every))


@functools.cache
def _begun(drive, scans, every):
    """The drive's first scans, thinned, and simulated once for all pages of a process."""

    @functools.cache
    def begun(*given, **named):
        return thinned(first(drive, scans, *given, **named), every)

    return functools.wraps(drive)(lambda *given, **named: copy.deepcopy(begun(*given, **named)))
