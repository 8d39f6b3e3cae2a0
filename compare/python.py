"""Times planish from Python, the same call in its Rust library, and Open3D's smooth_mls, numpy to numpy, on one frame.

usage: python.py FRAME.pcd [ROUNDS]

The library's call is timed in the same process, alternately with the calls from Python, and writes points and status
into reused buffers. Open3D gets the finite points, and its result is converted back to numpy. It runs in
its fastest configuration: the tensor class, 3 cm, at most 30 neighbours.
"""

import statistics
import sys
import time

import numpy as np

import planish

file = sys.argv[1]
rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 300
frame = planish.read(file)
outputs = ["points", "status"]


def timed(work, runs=15):
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def open3d_times():
    try:
        import open3d
    except ImportError:
        return None

    points = frame.array[np.isfinite(frame.array).all(axis=-1)]

    def work():
        cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor.from_numpy(points))
        return cloud.smooth_mls(0.03, 30).point.positions.numpy()

    return statistics.median(timed(work, 3))


print("| preset | library's call, ms | Python, own arrays, ms | over it | new arrays, ms | over it | Open3D, ms | over Python |")
print("|---|---|---|---|---|---|---|---|")
peer = open3d_times()
for preset in ("paper", "default"):
    smoother = planish.Smoother(preset=preset, engine="cpu", outputs=outputs)
    arrays = smoother.smooth(frame.array)
    written = {name: getattr(arrays, name) for name in outputs}
    library = lambda: smoother._engine.time_library(frame.array, False, (None, None, None, None), written, 1)[0]
    found = {"library": [], "own": [], "new": []}
    for _ in range(rounds):
        found["library"].append(library())
        found["own"] += timed(lambda: smoother.smooth(frame.array, out=arrays), 1)
        found["new"] += timed(lambda: smoother.smooth(frame.array), 1)
    call, own, new = (statistics.median(found[name]) for name in ("library", "own", "new"))
    over = "-" if peer is None else f"{peer:.0f} | {peer / own:.0f}"
    print(f"| {preset} | {call:.2f} | {own:.2f} | {own / call:.3f} | {new:.2f} | {new / call:.3f} | {over} |")
