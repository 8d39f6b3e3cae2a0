"""Cuts holes out of real depth images, fills them with planish, librealsense and OpenCV, and prints the table of fill_real.sh.

usage: fill_real.py PLANISH WORK WIDTH_PX SENSOR FX,FY,CX,CY UNITS_PER_METRE IMAGE ..

The measured depth of the pixels that were cut out counts as the truth, so its noise is part of every error.
"""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

HERE = Path(__file__).parent
# Number of ellipses to try per image. Ellipses that contain or touch a hole are left out.
TRIED = 1500
# Distance in pixels within which a step counts, and which must be measured around an ellipse.
NEAR_PX = 3
# Depth step of a Kinect v1 in metres, divided by the square of the depth.
DEPTH_STEP = 2.85e-3
WRONG_M = 0.02

Depth = NDArray[np.float64]
Mask = NDArray[np.bool_]


def near_steps(depth_m: Depth) -> Mask:
    """Returns the pixels within NEAR_PX of adjacent pixels on two surfaces."""
    steps = np.zeros(depth_m.shape, np.uint8)
    for axis in (0, 1):
        one, other = (depth_m[1:], depth_m[:-1]) if axis == 0 else (depth_m[:, 1:], depth_m[:, :-1])
        nearer = np.minimum(one, other)
        is_step = (nearer > 0) & (abs(one - other) > np.maximum(0.02 * nearer, 4 * DEPTH_STEP * nearer**2))
        (steps[1:] if axis == 0 else steps[:, 1:])[is_step] = 1
    return cv2.dilate(steps, np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)) > 0


def cut(depth_m: Depth, width_px: int, random: np.random.Generator) -> Mask:
    """Returns the pixels of random ellipses, at most `width_px` wide along one axis and three times as long."""
    height, width = depth_m.shape
    taken, holes = np.zeros(depth_m.shape, np.uint8), np.zeros(depth_m.shape, np.uint8)
    for _ in range(TRIED):
        narrow = random.uniform(1, (width_px - 1) / 2)
        axes = (narrow, narrow * random.uniform(1, 3))
        centre = random.uniform(0, width), random.uniform(0, height)
        ellipse = (centre, (2 * axes[0], 2 * axes[1]), random.uniform(0, 180))
        one, around = np.zeros(depth_m.shape, np.uint8), np.zeros(depth_m.shape, np.uint8)
        cv2.ellipse(one, ellipse, 1, -1)
        around = cv2.dilate(one, np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8))
        if (around & ((depth_m == 0) | (taken > 0))).any():
            continue
        holes |= one
        taken |= around
    return holes > 0


def read_mm(file: Path) -> Depth:
    return np.asarray(Image.open(file)).astype(np.float64) / 1000


def main() -> None:
    planish, work, width_px, sensor, camera, units = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:7]
    random = np.random.default_rng(1)
    (work / "cut").mkdir(parents=True)
    truth: dict[str, Depth] = {}
    holes: dict[str, Mask] = {}
    for number, file in enumerate(sys.argv[7:]):
        raw = np.asarray(Image.open(file)).astype(np.float64)
        # 65535 marks saturated pixels of a RealSense. PNGs in mm are the input of all programs.
        depth_m = np.round(np.where(raw == 65535, 0, raw) / float(units) * 1000) / 1000
        name = f"{number:05}"
        truth[name], holes[name] = depth_m, cut(depth_m, width_px, random)
        image = np.where(holes[name], 0, 1000 * depth_m + 0.5).astype(np.uint16)
        Image.fromarray(image).save(work / "cut" / f"{name}.png")

    def smooth(out: str, *options: str) -> None:
        given = ["--camera", camera, "--sensor", sensor, *options]
        subprocess.run([planish, "smooth", work / "cut", work / out, *given], check=True, capture_output=True)

    smooth("planish", "--fill", str(width_px))
    smooth("smoothed")
    for given, filled in (("cut", "measured"), ("smoothed", "of planish")):
        subprocess.run([sys.executable, HERE / "fill.py", work / given, work / filled], check=True)
    ways = {"planish": {name: read_mm(work / "planish" / f"{name}.png") for name in truth}}
    for kind, suffix in (("measured", ""), ("of planish", " on planish's frames")):
        for folder in sorted((work / kind).iterdir()):
            ways[folder.name + suffix] = {name: np.load(folder / f"{name}.npy").astype(np.float64) for name in truth}
    for title, is_near in (("away from steps", False), ("within 3 px of a step", True)):
        chosen = {name: holes[name] & (near_steps(depth_m) == is_near) for name, depth_m in truth.items()}
        pixels = sum(int(mask.sum()) for mask in chosen.values())
        print(f"\n| {len(truth)} images, {title}: {pixels} pixels | filled, % | RMS, mm | RMS, depth steps | median, mm | wrong surface, % |")
        print("|---|--:|--:|--:|--:|--:|")
        for way, images in ways.items():
            found = np.concatenate([images[name][chosen[name]] for name in truth])
            known = np.concatenate([truth[name][chosen[name]] for name in truth])
            is_filled = np.isfinite(found) & (found > 0)
            found, known = found[is_filled], known[is_filled]
            off, step = abs(found - known), DEPTH_STEP * known**2
            wrong = off > np.maximum(WRONG_M, 3 * step)
            rms = (1000 * np.sqrt((off**2).mean()), np.sqrt(((off / step) ** 2).mean()))
            cells = [100 * is_filled.mean(), *rms, 1000 * np.median(off), 100 * wrong.mean()]
            formats = (".2f", ".1f", ".2f", ".1f", ".2f")
            print(f"| {way} | " + " | ".join(format(cell, form) for cell, form in zip(cells, formats)) + " |")


main()
