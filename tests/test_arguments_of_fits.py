# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Any scans for a fit and its estimate.

As in `test_arguments`; `python -m bench.stress arguments` tries more.
"""

from __future__ import annotations

import numpy as np
import radarsdf
from hypothesis import given
from hypothesis import strategies as st
from radarsdf import FitConfig

from .test_arguments import FLOATS, answer, arrays, examples, mostly, pose

TINY = FitConfig(
    num_threads=1,
    max_memory_bytes=10**9,
    returns={"min_range_m": 0.0},
    encoding={"num_levels": 2, "fourier_count": 2},
    networks={"sdf_hidden": (4,), "intensity_hidden": (4,)},
    training={"sdf_iterations": 1, "intensity_iterations": 1, "batch_size": 16, "intensity_batch_size": 16},
)


@examples(60)
@given(
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    poses=mostly(st.none(), arrays(2, 4, 4)),
    far=mostly(st.just(0.0), FLOATS),
    data=st.data(),
)
def test_fit_and_estimate(sizes, poses, far, data):
    points = [data.draw(arrays(size, 3)) for size in sizes]
    intensities = data.draw(st.sampled_from([None, [data.draw(arrays(size)) for size in sizes]]))
    if poses is None:
        poses = [pose(far * i) for i in range(len(sizes))]
    radar_map = answer(radarsdf.fit, points, poses, intensities, config=TINY, progress=False)
    estimate = answer(radarsdf.estimate, points, poses, intensities, config=TINY)
    if radar_map is None:
        return
    assert estimate is not None
    assert radar_map.report["returns_used"] <= estimate.returns
    assert 0 < estimate.peak_memory_bytes <= 10**9
    assert 0 < estimate.seconds < 60
    centres = (radar_map.field.cells.table.leaf_cells() + 0.5) * TINY.leaf_size_m + radar_map.origin
    for values in (radar_map.sdf(centres), radar_map.gradient(centres), radar_map.confidence(centres)):
        assert np.isfinite(values).all()
