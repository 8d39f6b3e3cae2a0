"""Open3D's smooth_mls on a PCD file: prints the median time of some runs in milliseconds, and the points that are left.

usage: open3d_mls.py FILE RADIUS_M MAX_NEIGHBOURS RUNS
"""

import statistics
import sys
import time

import open3d

file, radius_m, max_neighbours, runs = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
cloud = open3d.t.io.read_point_cloud(file).remove_non_finite_points()[0]
times = []
for _ in range(runs):
    start = time.perf_counter()
    smoothed = cloud.smooth_mls(radius_m, max_neighbours)
    times.append(1e3 * (time.perf_counter() - start))
print(f"{statistics.median(times):.3f} {len(smoothed.point.positions)}")
