"""Radar properties of surfaces: strength of the echo, its angular dependence, and its fading."""

from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from radarsdf.arrays import Floats

# A texture is three plane waves (rad/m), none of them along an axis, so that every face of a box shows it.
_TEXTURE_WAVES = np.array([[1.7, 0.9, 1.3], [-0.8, 2.1, -1.1], [0.5, -1.2, 2.6]])


@dataclass(frozen=True, config=ConfigDict(strict=True, allow_inf_nan=False))
class Material:
    """Radar properties of a surface.

    The echo of a surface at the incidence angle θ is ``reflectivity_db`` + 10·log10(lobe), where lobe is the sum of a
    diffuse lobe cos²θ and a specular lobe exp(-θ²/2w²), weighted by ``specular``. It is 1 at normal incidence.
    Construction raises a ValueError for a value outside the range in its comment.
    """

    name: str
    reflectivity_db: float  # echo at normal incidence, relative to the other materials [dB]
    specular: Annotated[float, Field(ge=0, le=1)] = 0.5  # share of the specular lobe at normal incidence
    lobe_width_rad: Annotated[float, Field(gt=0)] = 0.25  # w, standard deviation of the specular lobe [rad]
    looks: Annotated[float, Field(gt=0)] = 3.0  # independent scatterers per return: few mean strong fading
    texture_db: Annotated[float, Field(ge=0)] = 0.0  # amplitude of slow changes over the surface [dB], >= 0
    # Loss of a wave mirrored by the surface [dB], >= 0; inf: no ghosts.
    mirror_loss_db: Annotated[float, Field(ge=0, allow_inf_nan=True)] = np.inf

    def echo_db(self, points: Floats, cos_incidence: Floats) -> Floats:
        """Echo (N,), dB, of hits (N, 3), world frame, m, without the loss by range: reflectivity, texture and lobe."""
        texture = np.sin(points @ _TEXTURE_WAVES.T).mean(axis=1)
        cos = np.clip(cos_incidence, 1e-3, 1.0)
        specular = np.exp(-0.5 * (np.arccos(cos) / self.lobe_width_rad) ** 2)
        lobe_db = 10 * np.log10((1 - self.specular) * cos**2 + self.specular * specular + 1e-6)
        return self.reflectivity_db + self.texture_db * texture + lobe_db


GRASS = Material("grass", -13.0, specular=0.1, lobe_width_rad=0.5, looks=2.0, texture_db=3.0)
ASPHALT = Material("asphalt", -12.0, specular=0.3, lobe_width_rad=0.4, texture_db=1.5, mirror_loss_db=9.0)
CONCRETE = Material("concrete", 3.0, specular=0.8, lobe_width_rad=0.3, texture_db=2.0, mirror_loss_db=12.0)
BRICK = Material("brick", 1.0, specular=0.6, lobe_width_rad=0.4, texture_db=3.0, mirror_loss_db=18.0)
GLASS = Material("glass", 0.0, specular=0.97, lobe_width_rad=0.12, looks=4.0, mirror_loss_db=5.0)
METAL = Material("metal", 9.0, specular=0.9, lobe_width_rad=0.25, looks=2.0, mirror_loss_db=6.0)
# Of a corner reflector, without ghosts: `CornerReflector.retro_db` models the waves reflected between its plates.
REFLECTOR = Material("reflector plate", -6.0, specular=0.5, looks=8.0)
STEEL_POLE = Material("steel pole", 6.0, specular=0.6, lobe_width_rad=0.5)
TREE = Material("tree", -2.0, specular=0.2, lobe_width_rad=0.6, looks=2.0, texture_db=2.0)
