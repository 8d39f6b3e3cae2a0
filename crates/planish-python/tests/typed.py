"""Code that uses planish, for type checkers: mypy and pyright check this file, which is never run."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import assert_type

import planish
from planish.data import SmoothFrames


def smooth_all(frames: Iterable[NDArray[np.uint16]], camera: planish.Camera) -> list[NDArray[np.uint16]]:
    results: list[NDArray[np.uint16]] = []
    with planish.Smoother(camera, outputs=["depth"], preset="strong", sensor="d435") as smoother:
        for frame in frames:
            result = smoother.smooth(frame)
            assert_type(result, planish.Smoothed)
            assert_type(result.depth, NDArray[np.uint16])
            results.append(result.depth)
        assert_type(smoother.engine, str | None)
        assert_type(smoother.cloud_choice, planish.CloudChoice | None)
    return results


def once(points: NDArray[np.float32]) -> NDArray[np.float32]:
    return planish.smooth(points, neighbours=60, edges="robust").normals


def wrong(depth: NDArray[np.uint16], camera: planish.Camera) -> None:
    # mypy reports ignore comments that suppress no error.
    planish.smooth(depth, camera, preset="lightt")  # type: ignore[arg-type]
    planish.smooth(depth, camera, presett="light")  # type: ignore[call-arg]


def tools() -> None:
    planish.convert("scan.e57", "scan.laz", encoding=None)
    assert_type(planish.compare("a.pcd", "b.pcd").distances.rms, float)
    assert_type(planish.merge(["a.pcd", "b.pcd"], "c.ply"), int)
    assert_type(planish.mesh("depth.png", "chair.glb", camera=planish.Camera.kinect_v1(), preset="strong"), tuple[int, int])
    assert_type(planish.clean(planish.read("a.pcd"), voxel=0.01).points, NDArray[Any] | None)
    assert_type(planish.render(planish.read("a.pcd")), NDArray[np.uint8])


def files() -> None:
    frame = planish.read("scan.pcd")
    assert_type(frame.fields, dict[str, NDArray[Any]])
    planish.write("out.ply", frame, encoding="ascii")
    assert_type(planish.simulate("room").depth, NDArray[np.uint16])
    assert_type(planish.devices().auto, str)
    assert_type(SmoothFrames(planish.Camera.kinect_v1())({"depth": []}), dict[str, Any])
