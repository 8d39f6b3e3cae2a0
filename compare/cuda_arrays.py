"""Frames in CUDA memory: agreement with the CPU engine, time per frame, and frames per second. Needs an NVIDIA GPU.

    python compare/cuda_arrays.py [--quick]

Every setting is compared on two simulated frames, as 16-bit depth and in metres. Needs PyTorch, and tests CuPy and JAX if they
are installed. Fails if a limit of docs/method.md, section 9, is exceeded.
"""

import argparse
import os
import statistics
import time

os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
import numpy as np
import planish
import torch

SETTINGS = {
    "default": {},
    "light": {"preset": "light"},
    "strong": {"preset": "strong"},
    "paper": {"preset": "paper"},
    "sensor d435": {"sensor": "d435"},
    "edges off": {"edges": "off"},
    "degree 1": {"degree": 1},
    "degree 3": {"degree": 3},
    "along normals": {"project": "normal"},
    "no block means": {"average_blocks": False},
    "stride 1, window 7": {"stride": 1, "window": 7},
}
# Limits of the distance from the CPU engine in metres: for 99.9 % of the points, and for all points.
NEARLY_ALL_M, ALL_M = 1e-5, 6e-4
OUTPUTS = ["points", "normals", "curvature", "depth_m"]


class Foreign:
    """An array that offers only DLPack."""

    def __init__(self, tensor):
        self.tensor = tensor

    def __dlpack__(self, stream=None):
        return self.tensor.__dlpack__(stream=stream)

    def __dlpack_device__(self):
        return self.tensor.__dlpack_device__()


def on_gpu(depth):
    return torch.from_numpy(depth.view(np.int16) if depth.dtype == np.uint16 else depth).cuda()


def off_m(result, expected):
    """Returns distances between points: the 99.9 % quantile and the maximum. Holes must be equal."""
    result, expected = np.asarray(result)[:3], np.moveaxis(expected, 2, 0)
    assert np.array_equal(np.isnan(result), np.isnan(expected)), "holes differ"
    off = np.abs(result - expected)
    return float(np.nanquantile(off, 0.999)), float(np.nanmax(off))


def agreement(frames):
    print("| setting | 99.9 %, m | all, m | opened in s |\n|---|---|---|---|")
    for name, settings in SETTINGS.items():
        worst, seconds = [0.0, 0.0], 0.0
        for metres in (False, True):
            start = time.perf_counter()
            smoother = planish.CudaSmoother(frames[0].camera, metres=metres, outputs=OUTPUTS, **settings)
            seconds = max(seconds, time.perf_counter() - start)
            for frame in frames:
                raw = np.asarray(frame.depth)
                depth = raw.astype(np.float32) / np.float32(frame.camera.depth_units_per_metre) if metres else raw
                expected = planish.smooth(depth, frame.camera, engine="cpu", outputs=["points"], **settings).points
                found = off_m(smoother.smooth(on_gpu(depth)).cpu(), expected)
                worst = [max(pair) for pair in zip(worst, found)]
        print(f"| {name} | {worst[0]:.1e} | {worst[1]:.1e} | {seconds:.1f} |")
        assert worst[0] <= NEARLY_ALL_M and worst[1] <= ALL_M, name


def libraries(frames):
    smoother = planish.CudaSmoother(frames[0].camera)
    raw = np.asarray(frames[0].depth)
    depth = on_gpu(raw)
    expected = smoother.smooth(depth).clone()
    same = lambda result: torch.equal(torch.nan_to_num(result, nan=-1), torch.nan_to_num(expected, nan=-1))
    for count in (1, 3, 16, 17, 40):
        assert all(map(same, smoother.smooth_batch([depth] * count))), count
    wide = torch.zeros((480, 700), dtype=torch.int16, device="cuda")
    wide[:, :640] = depth
    assert same(smoother.smooth(wide[:, :640]))
    # Alternate between the current stream and new, busy streams.
    for _ in range(20):
        stream = torch.cuda.Stream()
        with torch.cuda.stream(stream):
            torch.randn(2000, 2000, device="cuda").matmul(torch.randn(2000, 2000, device="cuda"))
            on_stream = smoother.smooth(depth)
        assert same(smoother.smooth(depth))
        stream.synchronize()
        assert same(on_stream)
    explicit = torch.cuda.Stream()
    result = smoother.smooth(depth, stream=explicit.cuda_stream)
    explicit.synchronize()
    assert same(result)
    # A failed group must leave no frame in flight.
    try:
        smoother.smooth_batch([depth, Foreign(torch.zeros_like(depth).cpu())])
    except TypeError:
        assert all(map(same, smoother.smooth_batch([depth] * 2)))
    else:
        raise AssertionError("host memory was accepted")
    for kind in (Foreign(depth), Foreign(wide[:, :640])):
        array = smoother.smooth(kind)
        assert same(torch.from_dlpack(array)) and same(torch.as_tensor(array, device="cuda"))
        smoother.smooth(Foreign(torch.zeros_like(depth)), out=array)
        assert torch.from_dlpack(array).isnan().all()
    print("PyTorch, strides, groups, streams, DLPack: equal")
    try:
        import cupy
    except ImportError:
        print("CuPy is not installed")
    else:
        assert same(torch.as_tensor(smoother.smooth(cupy.asarray(raw)), device="cuda"))
        assert same(torch.as_tensor(cupy.from_dlpack(smoother.smooth(Foreign(depth))), device="cuda"))
        print("CuPy: equal")
    try:
        import jax
    except ImportError:
        print("JAX is not installed")
    else:
        image = jax.jit(lambda depth: depth + 0)(jax.numpy.asarray(raw))
        back = jax.dlpack.from_dlpack(smoother.smooth(image))
        assert same(torch.from_numpy(np.array(back)).cuda())
        print("JAX: equal")


def median_ms(call, calls):
    call()
    times = []
    for _ in range(calls):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def per_second(call, calls, frames):
    call()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(calls):
        call()
    torch.cuda.synchronize()
    return calls * frames / (time.perf_counter() - start)


def speed(frames):
    smoother = planish.CudaSmoother(frames[0].camera)
    depth = on_gpu(np.asarray(frames[0].depth))
    out = torch.empty((3, 480, 640), device="cuda")
    print("\n640x480, u16 depth to points, default\n\n| | |\n|---|---|")
    print(f"| one at a time, new array | {median_ms(lambda: smoother.smooth(depth), 500):.3f} ms |")
    print(f"| one at a time, given array | {median_ms(lambda: smoother.smooth(depth, out=out), 500):.3f} ms |")
    print(f"| one after another | {per_second(lambda: smoother.smooth(depth, out=out), 3000, 1):.0f} frames/s |")
    for count in (4, 16):
        rate = per_second(lambda: smoother.smooth_batch([depth] * count), 3000 // count, count)
        print(f"| groups of {count} | {rate:.0f} frames/s |")
    try:
        engine = planish.Smoother(camera=frames[0].camera, engine="gpu", outputs=["points"])
    except (RuntimeError, ValueError) as error:
        print(f"| through the host | {error} |")
        return

    def through_the_host():
        points = engine.smooth(depth.cpu().numpy().view(np.uint16)).points
        torch.from_numpy(points).cuda()

    print(f"| through the host | {median_ms(through_the_host, 100):.2f} ms |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="skip the timing")
    quick = parser.parse_args().quick
    simulated = [planish.simulate("room", seed=1), planish.simulate("table", seed=2)]
    print(f"planish {planish.__version__}, PyTorch {torch.__version__}, {torch.cuda.get_device_name(0)}\n")
    agreement(simulated)
    libraries(simulated)
    if not quick:
        speed(simulated)
