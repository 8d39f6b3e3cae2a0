"""Runs Open3D's smooth_mls on a PCD file. Prints the median time of the runs in milliseconds, and the number of remaining points.

usage: open3d_mls.py FILE legacy|tensor RADIUS_M MAX_NEIGHBOURS RUNS [OUTPUT.pcd]

legacy is geometry.PointCloud, tensor is t.geometry.PointCloud. At most MAX_NEIGHBOURS neighbours within the radius count, or all if it is 0.
Non-finite points are removed first, which is not timed. With an output, the result is put back on the grid of the input, with the normals
that Open3D estimates for it.
"""

import statistics
import sys
import time

import numpy
import open3d

import grid

file, api, radius_m, max_neighbours, runs = sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5])
cloud, is_there = open3d.t.io.read_point_cloud(file, remove_nan_points=False).remove_non_finite_points()
if max_neighbours > 0:
    search = open3d.geometry.KDTreeSearchParamHybrid(radius_m, max_neighbours)
else:
    # The hybrid search with a large maximum takes hundreds of times as long; the tensor API offers no alternative.
    search, max_neighbours = open3d.geometry.KDTreeSearchParamRadius(radius_m), 4096
legacy = cloud.to_legacy()
times = []
for _ in range(runs):
    start = time.perf_counter()
    smoothed = legacy.smooth_mls(search) if api == "legacy" else cloud.smooth_mls(radius_m, max_neighbours)
    times.append(1e3 * (time.perf_counter() - start))
if api == "legacy":
    smoothed = open3d.t.geometry.PointCloud.from_legacy(smoothed)
print(f"{statistics.median(times):.3f} {len(smoothed.point.positions)}")
if len(sys.argv) > 6:
    if "normals" not in smoothed.point:
        smoothed.estimate_normals(max_neighbours, radius_m)
    smoothed.orient_normals_towards_camera_location()
    pixels = numpy.flatnonzero(is_there.numpy())
    grid.write(sys.argv[6], pixels, smoothed.point.positions.numpy(), smoothed.point.normals.numpy())
