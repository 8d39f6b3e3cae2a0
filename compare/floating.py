"""Removes floating pixels from simulated frames with planish and with other methods, and prints a table.

usage: floating.py PLANISH WORK [SEED ..]

Needs Python with numpy, open3d and planish's wheel. A pixel floats if it is more than 1 cm and more than 4.6 standard deviations from every
true depth within 4 pixels. PCL's ShadowPoints is computed by its formula, |n · p| < 0.1, with normals from differences over 5 pixels.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import planish
from numpy.typing import NDArray

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Standard deviation of each simulated sensor in metres: coefficients of 1, z and z².
SENSORS = {
    "kinect1": (0.0, 0.0, 1.8e-3),
    "d435": (0.0, 0.0, 0.08 / (0.050 * 424)),
    "azure-kinect": (4.1e-4, 1.8e-4, 9.3e-5),
    "l515": (8.75e-4, 1.625e-3, 0.0),
}
CAMERA = planish.Camera(width=640, height=480, fx=525, fy=525, cx=319.5, cy=239.5)


def shifted(values: Depth, x: int, y: int) -> Depth:
    """Returns the values shifted by x columns and y rows; NaN outside."""
    moved = np.full_like(values, np.nan)
    height, width = values.shape
    rows = slice(max(0, y), height + min(0, y)), slice(max(0, -y), height + min(0, -y))
    columns = slice(max(0, x), width + min(0, x)), slice(max(0, -x), width + min(0, -x))
    moved[rows[1], columns[1]] = values[rows[0], columns[0]]
    return moved


def floating(measured: Depth, true: Depth, sensor: str) -> Mask:
    c0, c1, c2 = SENSORS[sensor]
    nearest = np.full_like(measured, np.inf)
    for y in range(-4, 5):
        for x in range(-4, 5):
            nearest = np.fmin(nearest, np.abs(measured - shifted(true, x, y)))
    limit = np.maximum(0.01, 4.6 * (c0 + measured * (c1 + measured * c2)))
    return np.isfinite(measured) & (nearest > limit)


def deprojected(depth: Depth) -> NDArray[np.float64]:
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    return np.stack([(u - CAMERA.cx) * depth / CAMERA.fx, (v - CAMERA.cy) * depth / CAMERA.fy, depth], -1).astype(np.float64)


def by_planish(depth: Depth, sensor: str) -> Mask:
    raw = np.nan_to_num(depth * 1000 + 0.5).astype(np.uint16)
    kept, _ = planish.prepare(raw, CAMERA, remove_floating=True, sensor=sensor)
    return (raw > 0) & (kept == 0)


def by_open3d(remove: Callable[[o3d.geometry.PointCloud], tuple[object, list[int]]]) -> Callable[[Depth, str], Mask]:
    def removed(depth: Depth, _: str) -> Mask:
        valid = np.isfinite(depth)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(deprojected(depth)[valid]))
        gone = np.ones(len(cloud.points), bool)
        gone[remove(cloud)[1]] = False
        mask = np.zeros(depth.shape, bool)
        mask[valid] = gone
        return mask

    return removed


def shadow_points(depth: Depth, _: str) -> Mask:
    points = deprojected(depth)
    along = [np.stack([shifted(points[..., k], *step) - shifted(points[..., k], -step[0], -step[1]) for k in range(3)], -1) for step in ((2, 0), (0, 2))]
    normals = np.cross(*along)
    with np.errstate(all="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.isfinite(depth) & (np.abs((normals * points).sum(-1)) < 0.1)


WAYS: dict[str, Callable[[Depth, str], Mask]] = {
    "planish": by_planish,
    "Open3D, statistical, 20 neighbours, 2 deviations": by_open3d(lambda cloud: cloud.remove_statistical_outlier(20, 2.0)),
    "Open3D, radius, 5 in 2 cm": by_open3d(lambda cloud: cloud.remove_radius_outlier(5, 0.02)),
    "Open3D, radius, 16 in 5 cm": by_open3d(lambda cloud: cloud.remove_radius_outlier(16, 0.05)),
    "PCL's ShadowPoints, by its formula": shadow_points,
}


def frames(command: str, work: Path, sensor: str, seed: str) -> dict[str, Depth]:
    folder = work / f"{sensor}-{seed}"
    subprocess.run([command, "evaluate", "--sensor", sensor, "--seed", seed, "--export", folder], check=True, capture_output=True)
    return {file.name: planish.read(file).points[..., 2] for file in sorted(folder.glob("*.pcd"))}


def main() -> None:
    command, work, seeds = sys.argv[1], Path(sys.argv[2]), sys.argv[3:] or ["1"]
    true = {name: depth for seed in seeds for name, depth in frames(command, work, "exact", seed).items()}
    print("| recall, precision, false, % | " + " | ".join(SENSORS) + " |\n|---|" + "--:|" * len(SENSORS))
    cells: dict[str, list[str]] = {way: [] for way in WAYS}
    for sensor in SENSORS:
        measured = {name: depth for seed in seeds for name, depth in frames(command, work, sensor, seed).items()}
        floats = {name: floating(depth, true[name], sensor) for name, depth in measured.items()}
        for way, remove in WAYS.items():
            removed = {name: remove(depth, sensor) for name, depth in measured.items()}
            right = sum(int((removed[name] & floats[name]).sum()) for name in measured)
            all_floating = sum(int(mask.sum()) for mask in floats.values())
            all_removed = sum(int(mask.sum()) for mask in removed.values())
            others = sum(int(np.isfinite(depth).sum()) for depth in measured.values()) - all_floating
            cells[way].append(f"{100 * right / all_floating:.1f}, {100 * right / max(all_removed, 1):.1f}, {100 * (all_removed - right) / others:.3f}")
    for way, row in cells.items():
        print(f"| {way} | " + " | ".join(row) + " |")


main()
