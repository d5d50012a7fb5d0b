"""Fit a street in tiles, resume after a tile was lost, and export one mesh.

python examples/tiles.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import radarsdf
from radarsdf.io import Scans


def main(folder: Path) -> None:
    """Write the tiles and the mesh to a folder."""
    street = radarsdf.simulate.hugin(frames=30)
    scans = Scans(street.points, street.poses)
    config = radarsdf.FitConfig.quick(num_threads=1)
    city = radarsdf.fit_tiles(scans, folder / "city", tile_size=32, config=config, progress=False)
    print(city)

    # Simulate a crash: one tile is missing. The same call fits it again, with the same bits.
    lost = folder / "city" / "tiles" / city.tiles[0].name / "map.safetensors"
    lost.unlink()
    city = radarsdf.fit_tiles(scans, folder / "city", tile_size=32, config=config, progress=False)
    print(f"{len(city.missing)} tiles are missing")

    # Queries work across tile borders: here, the distances of the returns from the surface.
    distance_m = np.abs(city.sdf(street.world_points()))  # NaN where no tile observed a point
    print(f"{np.isfinite(distance_m).mean():.0%} of the returns are in observed space,")
    print(f"at a median distance of {np.nanmedian(distance_m):.3f} m from the surface")
    vertices, triangles = city.export(folder / "city.ply", 0.2, progress=False)
    print(f"{vertices} vertices and {triangles} triangles")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
