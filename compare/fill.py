"""Fills the holes of depth images with librealsense and OpenCV, for `planish evaluate --fill N --results`.

usage: fill.py FOLDER WORK

FOLDER contains depth images in millimetres, or in metres (.npy). Writes WORK/<way>/NAME.npy, depth in metres, for each way: librealsense's
hole filling in its three modes, and OpenCV's inpainting by Telea and by Navier-Stokes. They fill every hole, because neither librealsense
nor OpenCV can limit the width of the holes.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray
from PIL import Image

# Depth unit for librealsense, which computes with whole units.
UNIT_M = 2e-4
# Maximum distance in pixels from which OpenCV inpaints.
REACH_PX = 3
WAYS = {"rs, from the left": 0, "rs, farthest": 1, "rs, nearest": 2}


class RealSense:
    """A software camera with a hole-filling filter."""

    def __init__(self, shape: tuple[int, int], mode: int) -> None:
        height, width = shape
        self.device = rs.software_device()
        self.sensor = self.device.add_sensor("depth")
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid = rs.stream.depth, 0, 0
        stream.width, stream.height, stream.fps, stream.bpp, stream.fmt = width, height, 30, 2, rs.format.z16
        intrinsics = rs.intrinsics()
        intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = width, height, 525.0, 525.0
        stream.intrinsics = intrinsics
        self.profile = self.sensor.add_video_stream(stream)
        self.sensor.add_read_only_option(rs.option.depth_units, UNIT_M)
        self.queue = rs.frame_queue(1)
        self.sensor.open(self.profile)
        self.sensor.start(self.queue)
        self.filter = rs.hole_filling_filter(mode)
        self.number = 0

    def fill(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        self.number += 1
        given = rs.software_video_frame()
        given.pixels = np.ascontiguousarray((depth_m / UNIT_M + 0.5).clip(0, 65535).astype(np.uint16))
        given.bpp, given.stride = 2, 2 * depth_m.shape[1]
        given.timestamp, given.domain, given.frame_number = 33.3 * self.number, rs.timestamp_domain.hardware_clock, self.number
        given.profile, given.depth_units = self.profile.as_video_stream_profile(), UNIT_M
        self.sensor.on_video_frame(given)
        taken = self.filter.process(self.queue.wait_for_frame())
        return np.asanyarray(taken.get_data()).astype(np.float32) * np.float32(UNIT_M)


def main() -> None:
    folder, work = Path(sys.argv[1]), Path(sys.argv[2])
    frames: dict[str, NDArray[np.float32]] = {}
    for file in sorted(folder.iterdir()):
        if file.name.endswith(".origin.png") or file.suffix not in (".png", ".npy"):
            continue
        depth = np.load(file) if file.suffix == ".npy" else np.asarray(Image.open(file)) / 1000
        frames[file.stem] = np.nan_to_num(depth).astype(np.float32)
    shape = next(iter(frames.values())).shape

    def write(way: str, name: str, depth_m: NDArray[np.float32]) -> None:
        (work / way).mkdir(parents=True, exist_ok=True)
        np.save(work / way / f"{name}.npy", depth_m)

    for way, mode in WAYS.items():
        camera = RealSense(shape, mode)
        for name, depth_m in frames.items():
            write(way, name, camera.fill(depth_m))
    for name, depth_m in frames.items():
        holes = (depth_m == 0).astype(np.uint8)
        # Use whole units: with metres as float32, Telea's result is off by a metre.
        raw = (depth_m / UNIT_M + 0.5).clip(0, 65535).astype(np.uint16)
        for way, method in (("OpenCV, Telea", cv2.INPAINT_TELEA), ("OpenCV, Navier-Stokes", cv2.INPAINT_NS)):
            write(way, name, cv2.inpaint(raw, holes, REACH_PX, method).astype(np.float32) * np.float32(UNIT_M))


main()
