"""
Map in tiles
============

A recording larger than memory becomes one map per square of the ground, used as one.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import radarsdf
from radarsdf.io import Scans
from radarsdf.render.picture import render

street = radarsdf.simulate.hugin(frames=30)
scans = Scans(street.points, street.poses)  # or radarsdf.io.read("drive.mcap"): it streams
config = radarsdf.FitConfig.quick(num_threads=1)
folder = Path(tempfile.mkdtemp()) / "city"
city = radarsdf.fit_tiles(scans, folder, tile_size=32, config=config, progress=False)
print(city)

# %%
# A crash loses a tile. The same call fits what is missing, with the same bits.

(folder / "tiles" / city.tiles[0].name / "map.safetensors").unlink()
city = radarsdf.fit_tiles(scans, folder, tile_size=32, config=config, progress=False)

# %%
# Queries and meshes cross borders without a seam.

distance_m = np.abs(city.sdf(street.world_points()))  # NaN where no tile observed a point
print(f"median distance of the returns from the surface: {np.nanmedian(distance_m):.3f} m")
mesh = city.mesh(0.2, progress=False)

# %%
# The surface, coloured by tile.

tile = np.floor(mesh.vertices[:, :2] / 32).astype(int)
colors = plt.cm.Set2(np.unique(tile, axis=0, return_inverse=True)[1].ravel() % 8, bytes=True)
figure, axes = plt.subplots(figsize=(10, 4.7), layout="constrained")
axes.imshow(render(mesh, colors, width=720, height=320))
axes.axis("off")
plt.show()
