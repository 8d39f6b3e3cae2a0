"""Filling of holes."""

import numpy as np
import planish
import pytest


def test_holes_are_filled_and_flagged() -> None:
    frame = planish.simulate("table")
    depth = frame.depth.copy()
    hole = np.s_[200:204, 300:304]
    depth[hole] = 0
    result = planish.smooth(depth, frame.camera, fill=8, outputs=("points", "depth", "status", "sigma"))
    assert (result.status[hole] == planish.Status.FILLED).all()
    assert (result.origin[hole] == planish.Origin.FILLED).all()
    assert np.isfinite(result.points[hole]).all() and (result.sigma[hole] > 0).all()
    assert np.abs(result.depth[hole].astype(int) - frame.depth[hole].astype(int)).max() < 30
    assert set(np.unique(result.origin)) <= {int(origin) for origin in planish.Origin}
    with pytest.raises(ValueError, match="fill = 8 is not allowed: only if status is among the outputs"):
        planish.smooth(depth, frame.camera, fill=8, outputs=("points",))
    with pytest.raises(ValueError, match="1 to 64 pixels"):
        planish.smooth(depth, frame.camera, fill=0)
    with pytest.raises(ValueError, match="add \"status\" to the outputs"):
        _ = planish.smooth(depth, frame.camera, outputs=("points",)).origin


def test_a_gpu_fills_batches_of_depth_and_of_points() -> None:
    if not planish.devices().gpus:
        pytest.skip("no GPU adapter")
    frame = planish.simulate("table")
    depth = frame.depth.copy()
    hole = np.s_[200:204, 300:304]
    depth[hole] = 0
    outputs = ("points", "status")
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    z = np.where(depth > 0, depth, np.nan) / 1000
    rays = [(u - frame.camera.cx) / frame.camera.fx, (v - frame.camera.cy) / frame.camera.fy, np.ones_like(z)]
    points = (np.stack(rays, axis=-1) * z[..., None]).astype(np.float32)
    for image, camera in ((depth, frame.camera), (points, None)):
        smoother = planish.Smoother(camera, engine="gpu", adapter=0, fill=8, outputs=outputs)
        status = smoother.smooth_batch([image, image]).status
        assert status.shape == (2, *depth.shape)
        assert (status[(slice(None), *hole)] == planish.Status.FILLED).all()
