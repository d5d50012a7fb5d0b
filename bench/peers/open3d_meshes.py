"""α-shapes, ball pivoting and Poisson reconstruction by Open3D, on all returns together."""

import numpy as np
import open3d as o3d

from .child import ScanArrays

Mesh = tuple[np.ndarray, np.ndarray, None]  # vertices, faces; these methods have no map

_NORMAL_NEIGHBOURS = 30  # Open3D's default


def alpha_shapes(scans: ScanArrays, alpha_m: float) -> Mesh:
    """Faces of the Delaunay tetrahedra whose circumscribed ball is smaller than `alpha_m` (Edelsbrunner et al.)."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scans.world()))
    return _arrays(o3d.geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, alpha_m))


def ball_pivoting(scans: ScanArrays, radius_m: float) -> Mesh:
    """Triangles at whose corners a ball of `radius_m` rests as it rolls over the points (Bernardini et al.)."""
    cloud = _with_normals(scans)
    radii = o3d.utility.DoubleVector([radius_m])
    return _arrays(o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii))


def poisson(scans: ScanArrays, depth: int) -> Mesh:
    """Screened Poisson reconstruction on an octree of `depth` levels (Kazhdan, Hoppe)."""
    return _arrays(
        o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(_with_normals(scans), depth=depth)[0]
    )


def _with_normals(scans: ScanArrays) -> o3d.geometry.PointCloud:
    """Points with normals of planes through their neighbours, oriented towards the sensor."""
    world = scans.world()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(world))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    away = np.einsum("ij,ij->i", normals, scans.sensors() - world) < 0
    cloud.normals = o3d.utility.Vector3dVector(np.where(away[:, None], -normals, normals))
    return cloud


def _arrays(mesh: o3d.geometry.TriangleMesh) -> Mesh:
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles), None
