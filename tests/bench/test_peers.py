"""Peers run in separate processes with the same interface, and report why they cannot run."""

import importlib.util

import numpy as np
import pytest
import radarsdf

from bench.peers.interface import PEERS, Peer, reconstruct

OURS = PEERS["radarsdf"].with_changes(training={"sdf_iterations": 60}, mesh={"min_component_triangles": 20})


@pytest.fixture(scope="module")
def scans():
    return radarsdf.simulate.wall(frames=3)


def queries_of(points, poses):
    """All returns and their sensor positions, world frame."""
    at = [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(points, poses, strict=True)]
    return np.concatenate(at), np.repeat(poses[:, :3, 3], [len(scan) for scan in points], axis=0)


@pytest.fixture(scope="module")
def usual(scans):
    """Our surface without intensities, although intensities and queries are given."""
    queries = queries_of(scans.points, scans.poses)
    return reconstruct(OURS, scans.points, scans.poses, scans.intensities, queries=queries)


def test_a_peer_for_surfaces_predicts_no_intensities(usual):
    assert usual.mesh is not None
    assert usual.seconds > 0
    assert usual.peak_bytes > 50e6
    assert usual.intensity is None


def test_far_from_the_origin_results_are_in_the_world_frame(scans):
    peer = PEERS["radarsdf, intensities"].with_changes(
        training={"sdf_iterations": 60, "intensity_iterations": 300}, mesh={"min_component_triangles": 20}
    )
    shift = np.array([5e5, 5.4e6, 100.0])
    poses = scans.poses.copy()
    poses[:, :3, 3] += shift
    queries = queries_of(scans.points, poses)
    there = reconstruct(peer, scans.points, poses, scans.intensities, queries=queries)
    assert there.mesh is not None
    distance_m = scans.scene.signed_distance(there.mesh.triangles_center - shift)
    assert np.median(np.abs(distance_m)) < 0.05
    measured = np.concatenate(scans.intensities)
    assert there.intensity is not None
    assert np.abs(there.intensity - measured).mean() < 0.5 * np.abs(measured - measured.mean()).mean()
    assert there.report["training_s"] + there.report["mesh_s"] < there.seconds


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
def test_a_peer_that_cannot_run_reports_the_reason(scans, peer, why_not):
    done = reconstruct(peer, scans.points, scans.poses)
    assert done.mesh is None
    assert why_not in done.why_not


@pytest.mark.parametrize("name", ["α-shapes", "BPA", "VDBFusion"])
def test_the_surface_is_near_the_returns(scans, name):
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
