"""Reads and writes files of scans, poses, point clouds and meshes."""

from radarsdf.io.cloud_writing import write_cloud
from radarsdf.io.clouds import read_points
from radarsdf.io.meshes import read_mesh, write_mesh
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.io.poses import UNPOSED, NoPoses, write_poses
from radarsdf.io.read import read
from radarsdf.rig import Imu
from radarsdf.scans import Scan, Scans

__all__ = [
    "UNPOSED",
    "Imu",
    "NoPoses",
    "Scan",
    "Scans",
    "read",
    "read_mesh",
    "read_points",
    "read_scans",
    "write_cloud",
    "write_mesh",
    "write_poses",
    "write_scans",
]
