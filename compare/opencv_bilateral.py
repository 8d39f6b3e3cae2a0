"""Runs OpenCV's bilateral filter, 13x13, on the depth of a PCD file. Prints the median time of the runs in milliseconds.

usage: opencv_bilateral.py FILE RUNS OUTPUT.pcd

Each pixel's depth is averaged with the depths of its window that differ by up to about 3 cm; holes are kept. Readers of the result
compute the normals.
"""

import statistics
import sys
import time

import cv2

import grid

file, runs, output = sys.argv[1], int(sys.argv[2]), sys.argv[3]
z = grid.read_depth(file)
times = []
for _ in range(runs):
    start = time.perf_counter()
    smooth = cv2.bilateralFilter(z, 13, 0.03, 4.0)
    times.append(1e3 * (time.perf_counter() - start))
smooth[z == 0] = 0
pixels, points = grid.deproject(smooth)
grid.write(output, pixels, points)
print(f"{statistics.median(times):.3f} {len(pixels)}")
