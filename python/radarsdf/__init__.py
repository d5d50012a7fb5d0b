"""From 3D radar scans with known poses to a surface and a reflectance map, on a CPU."""

import torch  # noqa: F401 - before the compiled core, which then shares PyTorch's OpenMP runtime

from radarsdf import simulate
from radarsdf.config import FitConfig
from radarsdf.fitting import fit
from radarsdf.isosurface import marching_cubes
from radarsdf.map import RadarMap
from radarsdf.storage import load

__all__ = ["FitConfig", "RadarMap", "fit", "load", "marching_cubes", "simulate"]
