"""Reads and writes files of scans, poses, point clouds and meshes."""

from radarsdf.io.clouds import read_points as read_points
from radarsdf.io.clouds import write_cloud as write_cloud
from radarsdf.io.meshes import read_mesh as read_mesh
from radarsdf.io.meshes import write_mesh as write_mesh
from radarsdf.io.npz import read_scans as read_scans
from radarsdf.io.npz import write_scans as write_scans
from radarsdf.io.poses import UNPOSED as UNPOSED
from radarsdf.io.poses import NoPoses as NoPoses
from radarsdf.io.poses import write_poses as write_poses
from radarsdf.io.read import read as read
from radarsdf.rig import Imu as Imu
from radarsdf.scans import Scan as Scan
from radarsdf.scans import Scans as Scans
