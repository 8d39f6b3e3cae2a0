"""Open3D's outlier filters and voxel grid, timed: FRAME.pcd RADIUS_M VOXEL_M. Prints lines of: operation, median ms of 5, points left."""

import statistics
import sys
import time

import open3d


def report(name, run):
    times_ms = []
    for _ in range(5):
        start = time.perf_counter()
        out = run()
        times_ms.append(1e3 * (time.perf_counter() - start))
    print(name, f"{statistics.median(times_ms):.2f}", len(out.points))


cloud = open3d.io.read_point_cloud(sys.argv[1]).remove_non_finite_points()
radius, voxel = float(sys.argv[2]), float(sys.argv[3])
# Its number of neighbours counts the point itself.
report("statistical", lambda: cloud.remove_statistical_outlier(21, 2.0)[0])
report("radius", lambda: cloud.remove_radius_outlier(5, radius)[0])
report("voxel", lambda: cloud.voxel_down_sample(voxel))
