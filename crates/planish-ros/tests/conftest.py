"""Shared by the tests: the programs under test, and depth images like those of a camera."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
WIDTH, HEIGHT, FOCAL = 160, 120, 131.25


def program(name):
    """Returns the path of one of the project's programs, from the newest build."""
    built = [path for profile in ("release", "debug") if (path := TARGET / profile / name).exists()]
    if not built:
        pytest.fail(f"{name} is not built: cargo build --workspace")
    return str(max(built, key=lambda path: path.stat().st_mtime))


def smooth(*arguments, code=0):
    """Runs `planish smooth`, checks the exit code, and returns the output."""
    run = subprocess.run([program("planish"), "smooth", *map(str, arguments)], capture_output=True, text=True, timeout=120)
    assert run.returncode == code, run.stdout + run.stderr
    return run.stdout + run.stderr


def depth_mm(seed, width=WIDTH, height=HEIGHT):
    """A bent wall with a box in front of it, as a noisy camera sees it, in millimetres; the left columns are holes."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    z = 1.2 + 0.3 * u / width + 0.1 * np.sin(v / 10)
    z[height // 4 : height // 2, width // 3 : width // 2] -= 0.3
    z = z + np.random.default_rng(seed).normal(size=z.shape) * 0.002
    depth = np.round(1000 * z).astype(np.uint16)
    depth[:, :4] = 0
    return depth


def roughness(depth):
    """Returns the median second difference of depth along rows, without the columns of holes."""
    depth = np.asarray(depth, float)
    second = np.abs(depth[:, 10:-2] - 2 * depth[:, 11:-1] + depth[:, 12:])
    return float(np.nanmedian(second))


CAMERA = [FOCAL, 0.0, WIDTH / 2 - 0.5, 0.0, FOCAL, HEIGHT / 2 - 0.5, 0.0, 0.0, 1.0]
PROJECTION = [FOCAL, 0.0, WIDTH / 2 - 0.5, 0.0, 0.0, FOCAL, HEIGHT / 2 - 0.5, 0.0, 0.0, 0.0, 1.0, 0.0]
