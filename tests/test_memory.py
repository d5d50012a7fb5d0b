# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The memory that is left is the least of what system and control groups have, and a mesh beyond it is refused."""

import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.memory import available_bytes


def tree(root, groups, **files):
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable: 5000 kB\n")
    (root / "proc/self/cgroup").write_text(groups)
    for name, content in files.items():
        path = root / "sys/fs/cgroup" / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(path.name.replace("memory_", "memory.")).write_text(content)


def test_of_the_system(tmp_path):
    tree(tmp_path, "0::/\n", memory_max="max\n", memory_current="7")
    assert available_bytes(tmp_path) == 5000 * 1024


def test_of_a_control_group(tmp_path):
    files = {"a__b__memory_max": "3000000", "a__b__memory_current": "1000000"}
    tree(tmp_path, "0::/a/b\n", **files, a__b__memory_stat="anon 5\ninactive_file 200000\n")
    assert available_bytes(tmp_path) == 2_200_000


def test_a_mesh_beyond_the_budget_is_refused(scene):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(max_memory_bytes=10**9))
    radar_map.mesh(0.1)
    with pytest.raises(MemoryError, match=r"voxels of 0\.005 m"):
        radar_map.mesh(0.005)
