"""Smooths videos over time with other filters, for `planish evaluate --sequence --results`.

usage: temporal.py PLANISH WORK VIDEO CAMERA

VIDEO is a folder of depth images in millimetres, CAMERA its FX,FY,CX,CY. Writes WORK/<way>/NNNN.npy, depth in metres, for each way:
librealsense's temporal filter after its disparity transform (as in its viewer) and on depth, an exponential mean, and a median of
five frames. Each runs on the measured frames, and on the frames that planish smoothed individually.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray
from PIL import Image

Frames = list[NDArray[np.float32]]

# Depth unit for librealsense, which computes with whole units: a camera's millimetres.
UNIT_M = 1e-3
# Finer depth unit, which preserves the results of planish.
FINE_UNIT_M = 2e-4


def realsense(frames: Frames, in_disparity: bool, unit_m: float, focal_px: float) -> Iterator[NDArray[np.float32]]:
    """Applies librealsense's temporal filter with its default parameters (alpha 0.4, delta 20, persistency 3), on a software camera."""
    height, width = frames[0].shape
    device = rs.software_device()
    sensor = device.add_sensor("depth")
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid = rs.stream.depth, 0, 0
    stream.width, stream.height, stream.fps, stream.bpp, stream.fmt = width, height, 30, 2, rs.format.z16
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = width, height
    intrinsics.fx = intrinsics.fy = focal_px
    intrinsics.ppx, intrinsics.ppy = width / 2, height / 2
    stream.intrinsics = intrinsics
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, unit_m)
    sensor.add_read_only_option(rs.option.stereo_baseline, 50.0)
    queue = rs.frame_queue(1)
    sensor.open(profile)
    sensor.start(queue)
    temporal, to_disparity, to_depth = rs.temporal_filter(), rs.disparity_transform(True), rs.disparity_transform(False)
    if not in_disparity:
        # Set the default of 20 mm in this unit.
        temporal.set_option(rs.option.filter_smooth_delta, round(0.02 / unit_m))
    for number, frame in enumerate(frames):
        given = rs.software_video_frame()
        given.pixels = np.ascontiguousarray(np.nan_to_num(frame / unit_m + 0.5).clip(0, 65535).astype(np.uint16))
        given.bpp, given.stride = 2, 2 * width
        given.timestamp, given.domain, given.frame_number = 33.3 * number, rs.timestamp_domain.hardware_clock, number + 1
        given.profile, given.depth_units = profile.as_video_stream_profile(), unit_m
        sensor.on_video_frame(given)
        taken = queue.wait_for_frame()
        if in_disparity:
            taken = to_depth.process(temporal.process(to_disparity.process(taken)))
        else:
            taken = temporal.process(taken)
        yield np.asanyarray(taken.get_data()).astype(np.float32) * np.float32(unit_m)
    sensor.stop()
    sensor.close()


def exponential_mean(frames: Frames) -> Iterator[NDArray[np.float32]]:
    """Yields an exponential mean with a weight of 0.1 per frame, as in many tutorials. A pixel restarts after a hole."""
    mean = np.full_like(frames[0], np.nan)
    for frame in frames:
        mean = np.where(np.isnan(mean), frame, mean + np.float32(0.1) * (frame - mean))
        mean = np.where(np.isnan(frame), np.nan, mean)
        yield mean


def median_of_five(frames: Frames) -> Iterator[NDArray[np.float32]]:
    """Yields the median of the last five frames; holes do not count."""
    with np.errstate(all="ignore"):
        for number in range(len(frames)):
            last = np.stack(frames[max(0, number - 4) : number + 1])
            # NaN is sorted after all numbers.
            last, count = np.sort(last, axis=0), np.isfinite(last).sum(0)
            middle = np.take_along_axis(last, (np.maximum(count - 1, 0) // 2)[None], 0)[0]
            yield np.where(np.isnan(frames[number]), np.nan, middle)


def main() -> None:
    planish, work, video, camera = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4]
    # `--export` writes numbers of equal length, so the names sort in order.
    names = sorted(video.glob("*.png"))
    measured: Frames = []
    for name in names:
        raw = np.asarray(Image.open(name)).astype(np.float32)
        measured.append(np.where(raw > 0, raw / 1000, np.nan).astype(np.float32))
    # Use metres, so that planish's results are not rounded to millimetres.
    metres, alone = work / "metres", work / "frame-by-frame"
    metres.mkdir(parents=True, exist_ok=True)
    for name, depth in zip(names, measured, strict=True):
        np.save(metres / f"{name.stem}.npy", depth)
    subprocess.run([planish, "smooth", metres, alone, "--camera", camera], check=True, stdout=subprocess.DEVNULL)
    smoothed: Frames = [np.load(alone / f"{name.stem}.npy").astype(np.float32) for name in names]
    focal_px = float(camera.split(",")[0])
    ways: dict[str, Callable[[Frames, float], Iterator[NDArray[np.float32]]]] = {
        "rs": lambda frames, unit_m: realsense(frames, True, unit_m, focal_px),
        "rs depth": lambda frames, unit_m: realsense(frames, False, unit_m, focal_px),
        "exp. mean": lambda frames, _: exponential_mean(frames),
        "median 5": lambda frames, _: median_of_five(frames),
    }
    for way, smooth in ways.items():
        for name, frames, unit_m in ((way, measured, UNIT_M), (f"{way}, planish", smoothed, FINE_UNIT_M)):
            folder = work / name
            folder.mkdir(parents=True, exist_ok=True)
            given = [np.where(frame > 0, frame, np.nan).astype(np.float32) for frame in frames]
            for file, depth in zip(names, smooth(given, unit_m), strict=True):
                np.save(folder / f"{file.stem}.npy", depth.astype(np.float32))


main()
