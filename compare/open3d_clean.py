"""Times Open3D's outlier filters and voxel grid: FRAME.pcd RADIUS_M VOXEL_M. Prints one line per operation and API
(legacy or tensor): operation, median time of 5 runs in ms, number of remaining points, API."""

import statistics
import sys
import time

import open3d


def report(name, way, run, points_in):
    times_ms = []
    for _ in range(5):
        start = time.perf_counter()
        out = run()
        times_ms.append(1e3 * (time.perf_counter() - start))
    print(name, f"{statistics.median(times_ms):.2f}", len(points_in(out)), way)


radius, voxel = float(sys.argv[2]), float(sys.argv[3])
cloud = open3d.io.read_point_cloud(sys.argv[1]).remove_non_finite_points()
# Open3D's number of neighbours includes the point itself.
report("statistical", "legacy", lambda: cloud.remove_statistical_outlier(21, 2.0)[0], lambda out: out.points)
report("radius", "legacy", lambda: cloud.remove_radius_outlier(5, radius)[0], lambda out: out.points)
report("voxel", "legacy", lambda: cloud.voxel_down_sample(voxel), lambda out: out.points)

tensor = open3d.t.geometry.PointCloud.from_legacy(cloud)
report("statistical", "tensor", lambda: tensor.remove_statistical_outliers(21, 2.0)[0], lambda out: out.point.positions)
report("radius", "tensor", lambda: tensor.remove_radius_outliers(5, radius)[0], lambda out: out.point.positions)
report("voxel", "tensor", lambda: tensor.voxel_down_sample(voxel), lambda out: out.point.positions)
