"""Open3D's smooth_mls on a PCD file: prints the median time of some runs in milliseconds, and the points that are left.

usage: open3d_mls.py FILE RADIUS_M MAX_NEIGHBOURS RUNS [OUTPUT.pcd]

With an output the result is put back on the grid of the input, with the normals that Open3D estimates at it.
"""

import statistics
import sys
import time

import numpy
import open3d

import grid

file, radius_m, max_neighbours, runs = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
cloud, is_there = open3d.t.io.read_point_cloud(file, remove_nan_points=False).remove_non_finite_points()
times = []
for _ in range(runs):
    start = time.perf_counter()
    smoothed = cloud.smooth_mls(radius_m, max_neighbours)
    times.append(1e3 * (time.perf_counter() - start))
print(f"{statistics.median(times):.3f} {len(smoothed.point.positions)}")
if len(sys.argv) > 5:
    if "normals" not in smoothed.point:
        smoothed.estimate_normals(max_neighbours, radius_m)
    smoothed.orient_normals_towards_camera_location()
    pixels = numpy.flatnonzero(is_there.numpy())
    grid.write(sys.argv[5], pixels, smoothed.point.positions.numpy(), smoothed.point.normals.numpy())
