"""Writes open3d_fpfh.txt: Open3D's FPFH of cloud.txt, neighbours within 0.5."""

import numpy as np
import open3d as o3d

data = np.loadtxt("cloud.txt")
cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(data[:, :3]))
cloud.normals = o3d.utility.Vector3dVector(data[:, 3:])
search = o3d.geometry.KDTreeSearchParamRadius(0.5)
feature = o3d.pipelines.registration.compute_fpfh_feature(cloud, search)
np.savetxt("open3d_fpfh.txt", feature.data.T, fmt="%.6g")
