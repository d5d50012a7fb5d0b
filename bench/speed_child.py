"""Times fits of any version of radarsdf: a program of its own for `bench.speed`, that uses only its public functions."""

import json
import sys
import time

import numpy as np
import radarsdf

if __name__ == "__main__":
    with np.load(sys.argv[1]) as file:
        poses, own = file["poses"], np.cumsum(file["counts"])[:-1]
        points, intensities = np.split(file["points"], own), np.split(file["intensities"], own)
    for line in sys.stdin:
        case = json.loads(line)
        config = radarsdf.FitConfig.quick() if case["preset"] == "quick" else radarsdf.FitConfig()
        config = config.override(num_threads=case["threads"])
        begin = time.perf_counter()
        radar_map = radarsdf.fit(
            points, poses, intensities if case.get("intensities") else None, config=config, progress=False
        )
        if "voxel_m" in case:
            radar_map.mesh(case["voxel_m"], progress=False)
        print(time.perf_counter() - begin, flush=True)
