"""Plain visibility counts: cube by cube along each ray."""

import numpy as np

CUBE_CELLS = 8
PASSED_CUBES = 4


def looks_at(cells, leaf_size_m, points, directions, ranges_m, scans):
    """Numbers (C,) of scans with a ray that crosses or ends in the cube of each leaf cell.

    `cells` (C, 3): lattice coordinates; `points`, `directions` (N, 3), `ranges_m`, `scans` (N,). A ray is followed
    from its return until others of its scan have passed four cubes on end.
    """
    cubes, cube_of_cell = np.unique(np.floor_divide(cells, CUBE_CELLS), axis=0, return_inverse=True)
    row_of_cube = {tuple(cube): row for row, cube in enumerate(cubes.tolist())}
    counts = np.zeros(len(cubes), np.int64)
    for scan in np.unique(scans):
        passed = set()
        for i in np.flatnonzero(scans == scan):
            on_end = 0
            for cube in cubes_from_return(points[i], directions[i], ranges_m[i], CUBE_CELLS * leaf_size_m):
                on_end = on_end + 1 if cube in passed else 0
                passed.add(cube)
                if on_end == PASSED_CUBES:
                    break
        counts[[row_of_cube[cube] for cube in passed if cube in row_of_cube]] += 1
    return counts[cube_of_cell.reshape(-1)]


def cubes_from_return(point, direction, range_m, size_m):
    """Cubes crossed by a ray, as tuples, from its return to its sensor."""
    begin = point.astype(np.float64)
    step = -direction.astype(np.float64)
    end = begin + step * float(range_m)
    crossings_m = [0.0, float(range_m)]
    for axis in np.flatnonzero(step):
        low, high = sorted((begin[axis], end[axis]))
        faces = np.arange(np.floor(low / size_m) + 1, np.floor(high / size_m) + 1) * size_m
        crossings_m += ((faces - begin[axis]) / step[axis]).tolist()
    crossings_m = np.sort(crossings_m)
    middles_m = (crossings_m[1:] + crossings_m[:-1])[np.diff(crossings_m) > 0] / 2
    if not len(middles_m):
        middles_m = np.zeros(1)
    cubes = np.floor((begin + step * middles_m[:, None]) / size_m).astype(int)
    return [tuple(cube) for cube in cubes.tolist()]
