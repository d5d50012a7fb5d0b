# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Peers run in processes of their own, alike for all, and say why they cannot."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest
import radarsdf

from bench.peers.interface import PEERS, Peer, reconstruct

OURS = PEERS["radarsdf"].with_changes(training={"sdf_iterations": 60}, mesh={"min_component_triangles": 20})


@pytest.fixture(scope="module")
def scans():
    return radarsdf.simulate.wall(frames=3)


def queries_of(points, poses):
    """All returns, and where they were seen from, in the world."""
    at = [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(points, poses, strict=True)]
    return np.concatenate(at), np.repeat(poses[:, :3, 3], [len(scan) for scan in points], axis=0)


@pytest.fixture(scope="module")
def usual(scans):
    """Ours without intensities, in spite of being given them and asked for them."""
    queries = queries_of(scans.points, scans.poses)
    return reconstruct(OURS, scans.points, scans.poses, scans.intensities, queries=queries)


def test_the_paper_s_methods_are_there_in_its_order():
    assert list(PEERS)[:5] == ["α-shapes", "BPA", "Poisson", "VDBFusion", "SHINE (octree)"]


def test_changes_of_a_group_leave_its_other_settings():
    peer = PEERS["SHINE (octree)"].with_changes(encoding={"num_levels": 2}, seed=1, mesh={"voxel_size": 0.3})
    assert peer.options["changes"] == {
        "encoding": {"kind": "octree", "fourier_count": 0, "num_levels": 2},
        "training": {"learning_rate": 1e-2},
        "seed": 1,
    }
    published = {"min_confidence": 0.0, "max_uncertainty": math.inf, "min_component_triangles": 300}
    assert peer.options["mesh"] == {"voxel_size": 0.3, **published}
    assert "num_levels" not in PEERS["SHINE (octree)"].options["changes"]["encoding"]


def test_the_published_mesh_leaves_out_what_was_published():
    meshes = {name: peer.options["mesh"] for name, peer in PEERS.items() if "mesh" in peer.options}
    published = {name for name, mesh in meshes.items() if "min_component_triangles" in mesh}
    assert published == {"SHINE (octree)", "3QFP", "3QFPI"}
    assert meshes["radarsdf, quick"] == {"voxel_size": 0.2}


def test_the_mesh_s_arguments_arrive(scans):
    done = reconstruct(OURS.with_changes(mesh={"min_component_triangles": 10**9}), scans.points, scans.poses)
    assert done.why_not == "the mesh has no triangles"


def test_far_from_the_origin_the_same_mesh_comes_out_there(scans, usual):
    here = usual
    poses = scans.poses.copy()
    shift = np.array([5e5, 5.4e6, 100.0])
    poses[:, :3, 3] += shift
    there = reconstruct(OURS, scans.points, poses)
    assert here.mesh is not None
    assert there.mesh is not None
    assert here.map_bytes == there.map_bytes
    # Poses rounded at 1e-9 m are enough for a training to take other turns.
    assert len(there.mesh.faces) == pytest.approx(len(here.mesh.faces), rel=0.02)
    np.testing.assert_allclose(there.mesh.bounds - shift, here.mesh.bounds, atol=0.2)
    assert here.seconds > 0
    assert here.peak_bytes > 50e6


def test_intensities_are_predicted_at_queries_in_the_world(scans, usual):
    peer = PEERS["radarsdf, intensities"].with_changes(
        training={"sdf_iterations": 60, "intensity_iterations": 300}
    )
    poses = scans.poses.copy()
    poses[:, :3, 3] += [5e5, 5.4e6, 100.0]
    queries = queries_of(scans.points, poses)
    done = reconstruct(peer, scans.points, poses, scans.intensities, queries=queries)
    measured = np.concatenate(scans.intensities)
    assert done.intensity is not None
    assert np.abs(done.intensity - measured).mean() < 0.5 * np.abs(measured - measured.mean()).mean()
    assert done.report["training_s"] + done.report["mesh_s"] < done.seconds
    assert usual.intensity is None


def test_ranges_are_cut_for_all(scans):
    done = reconstruct(OURS, scans.points, scans.poses, min_range_m=50.0)
    assert done.mesh is None
    assert done.why_not == "no returns within the ranges"


def test_a_scan_without_returns_in_range_is_left_out(scans):
    points = [np.zeros((4, 3), np.float32), *scans.points[1:]]
    done = reconstruct(OURS, points, scans.poses)
    assert done.mesh is not None, done.why_not


@pytest.mark.parametrize(
    ("peer", "why_not"),
    [
        (
            Peer("absent", "child:main", {}, needs="no_such_module_at_all"),
            "No module named 'no_such_module_at_all'",
        ),
        (
            Peer("broken", "no_such_method:run", {}, needs="numpy"),
            "No module named 'bench.peers.no_such_method'",
        ),
        (
            Peer("unlike", "child:main", {"nonsense": 1}, needs="numpy"),
            "unexpected keyword argument 'nonsense'",
        ),
    ],
)
def test_a_peer_that_cannot_run_says_why(scans, peer, why_not):
    done = reconstruct(peer, scans.points, scans.poses)
    assert done.mesh is None
    assert why_not in done.why_not


def test_a_peer_that_takes_too_long_is_stopped(scans):
    done = reconstruct(OURS, scans.points, scans.poses, timeout_s=0.01)
    assert done.mesh is None
    assert "no result after" in done.why_not


@pytest.mark.parametrize("name", ["α-shapes", "BPA", "VDBFusion"])
def test_the_surface_is_where_the_returns_are(scans, name):
    peer = PEERS[name]
    done = reconstruct(peer, scans.points, scans.poses)
    if done.mesh is None and (
        importlib.util.find_spec(peer.needs) is None or "import" in done.why_not.lower()
    ):
        pytest.skip(f"{name}: {done.why_not}")
    assert done.mesh is not None, done.why_not
    distance_m = np.abs(scans.scene.signed_distance(done.mesh.triangles_center))
    assert np.median(np.abs(distance_m)) < 0.15
    assert (done.map_bytes is not None) == (name == "VDBFusion")
