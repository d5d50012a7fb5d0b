"""Odometry of a peer in its own environment: `python -m bench.peers.odometry_child NAME VOXEL_M SCANS POSES`.

SCANS is an .npz of `points` (N, 3), sensor frame, m, and `counts` (F,), returns per scan; POSES is the .npy output of
(F, 4, 4). Besides NumPy, only the peer's package is needed.
"""

import sys

import numpy as np


def kiss_icp(scans: list[np.ndarray], voxel_m: float, max_range_m: float) -> list[np.ndarray]:
    """KISS-ICP: point-to-point ICP on a voxel map with an adaptive threshold."""
    from kiss_icp.config import KISSConfig  # noqa: PLC0415 - an optional peer
    from kiss_icp.kiss_icp import KissICP  # noqa: PLC0415 - an optional peer

    config = KISSConfig()
    config.data.deskew = False  # returns have no times of their own
    config.data.max_range = max_range_m
    config.mapping.voxel_size = voxel_m
    odometry, poses = KissICP(config), []
    for scan in scans:
        odometry.register_frame(scan, np.zeros(len(scan)))
        poses.append(np.array(odometry.last_pose))
    return poses


def small_gicp(scans: list[np.ndarray], voxel_m: float, max_range_m: float) -> list[np.ndarray]:
    """GICP of each scan on a Gaussian voxel map, starting from constant velocity."""
    import small_gicp as peer  # noqa: PLC0415 - an optional peer

    target, T, step, poses = peer.GaussianVoxelMap(voxel_m), np.eye(4), np.eye(4), []
    for number, scan in enumerate(scans):
        near = scan[np.linalg.norm(scan, axis=1) <= max_range_m]
        source, _ = peer.preprocess_points(near, downsampling_resolution=voxel_m / 4)
        if number:
            found = peer.align(target, source, T @ step, max_correspondence_distance=3 * voxel_m)
            before, T = T, found.T_target_source
            step = np.linalg.inv(before) @ T
        target.insert(source, T)
        poses.append(np.array(T))
    return poses


PEERS = {"kiss-icp": kiss_icp, "small_gicp": small_gicp}
"""Methods by name."""


def main() -> None:
    name, voxel_m, scans_path, poses_path = sys.argv[1:]
    with np.load(scans_path) as file:
        points, counts = file["points"].astype(np.float64), file["counts"]
    scans = np.split(points, np.cumsum(counts)[:-1])
    farthest_m = float(np.linalg.norm(points, axis=1).max())
    np.save(poses_path, PEERS[name](scans, float(voxel_m), farthest_m))


if __name__ == "__main__":
    main()
