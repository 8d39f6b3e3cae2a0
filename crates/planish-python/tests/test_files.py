"""Files, simulated frames, scores, devices, and batches of a data pipeline."""

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

import planish
from planish.data import SmoothFrames

FRAME = planish.simulate("table")


def test_points_come_back_with_their_fields(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.random((500, 3), dtype=np.float32)
    fields = {"intensity": rng.random(500, dtype=np.float32), "label": np.arange(500, dtype=np.uint16)}
    for name, encoding in [("a.pcd", "binary"), ("b.pcd", "ascii"), ("c.pcd", "compressed"), ("d.ply", "binary")]:
        planish.write(tmp_path / name, points, fields=fields, pose=[0.1, 0, 0.6, 1, 0, 0, 0], encoding=encoding)
        frame = planish.read(tmp_path / name)
        assert np.array_equal(frame.points, points) and np.allclose(frame.pose, (0.1, 0, 0.6, 1, 0, 0, 0))
        assert all(np.array_equal(frame.fields[key], values) for key, values in fields.items())
        assert planish.info(tmp_path / name)["valid"] == 500
    far = points.astype(np.float64) + [637_000.0, 4_849_000.0, 0.0]
    planish.write(tmp_path / "map.laz", far)
    assert np.abs(planish.read(tmp_path / "map.laz").points - far).max() < 1e-3


def test_another_implementation_of_pcd_reads_and_writes_the_same(tmp_path):
    points = np.arange(36, dtype=np.float32).reshape(3, 4, 3) / 7
    points[1, 2] = np.nan
    scalars = {
        "intensity": np.arange(12, dtype=np.float32).reshape(3, 4),
        "ring": np.arange(12, dtype=np.uint16).reshape(3, 4),
        "t": np.arange(12).reshape(3, 4) / 8,
    }
    several = {"h": (np.arange(36, dtype=np.int32) - 9).reshape(3, 4, 3)}
    ours, theirs = tmp_path / "ours.pcd", tmp_path / "theirs.pcd"
    for encoding, their_encoding, fields in [
        ("ascii", Encoding.ASCII, scalars | several),
        ("binary", Encoding.BINARY, scalars | several),
        # In compressed files, the other reader stores each value of a field with several values separately, whereas PCL
        # stores the values of a point together.
        ("compressed", Encoding.BINARY_COMPRESSED, scalars),
    ]:
        planish.write(ours, points, fields=fields, encoding=encoding)
        found = PointCloud.from_path(ours)
        header = found.metadata
        assert (header.width, header.height, header.data) == (4, 3, their_encoding)
        assert (*header.fields,) == ("x", "y", "z", *fields)
        columns = dict(zip("xyz", points.reshape(-1, 3).T)) | {name: values.ravel() for name, values in scalars.items()}
        if "h" in fields:
            columns |= {f"h__{i:04d}": fields["h"].reshape(-1, 3)[:, i] for i in range(3)}
        for name, values in columns.items():
            column = found.pc_data[name]
            assert column.dtype == values.dtype and np.array_equal(column, values, equal_nan=values.dtype.kind == "f"), (encoding, name)
        found.save(theirs, their_encoding)
        again = planish.read(theirs)
        assert np.array_equal(again.points, points, equal_nan=True)
        assert all(np.array_equal(again.fields[name], values) for name, values in fields.items()), encoding


def test_grids_and_depth_come_back(tmp_path):
    frame = planish.simulate("room", camera=planish.Camera(160, 120, 131.0, 131.0))
    result = planish.smooth(frame.depth, frame.camera)
    planish.write(tmp_path / "grid.pcd", result.points, fields={"status": result.status})
    grid = planish.read(tmp_path / "grid.pcd")
    assert np.array_equal(grid.points, result.points, equal_nan=True)
    assert np.array_equal(grid.fields["status"], result.status)
    for name in ("depth.png", "depth.tiff", "depth.npy"):
        planish.write(tmp_path / name, frame.depth)
        assert np.array_equal(planish.read(tmp_path / name).depth, frame.depth)
        assert planish.info(tmp_path / name)["kind"] == "depth"
    planish.write(tmp_path / "copy.ply", grid)
    assert np.array_equal(planish.read(tmp_path / "copy.ply").fields["status"], result.status)


def test_fields_of_any_kind_come_back(tmp_path):
    points = np.random.default_rng(3).random((40, 3), dtype=np.float32)
    fields = {"fpfh": np.arange(120, dtype=np.float32).reshape(40, 3), "flag": np.arange(40) % 2 == 0, "big": np.arange(40, dtype=">i4")}
    planish.write(tmp_path / "a.pcd", points, fields=fields)
    found = planish.read(tmp_path / "a.pcd")
    assert all(np.array_equal(found.fields[name], values) for name, values in fields.items())
    planish.write(tmp_path / "b.pcd", found)
    assert np.array_equal(planish.read(tmp_path / "b.pcd").fields["fpfh"], fields["fpfh"])
    with pytest.raises(ValueError, match="npz"):
        planish.write(tmp_path / "a.npy", points, fields=fields)
    with pytest.raises(ValueError, match="npy"):
        planish.write(tmp_path / "a.png", np.ones((4, 5), np.float32))
    assert np.array_equal(planish.smooth(found).points, planish.smooth(found.points).points)


def test_files_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        planish.read(tmp_path / "none.pcd")
    broken = tmp_path / "broken.pcd"
    broken.write_bytes(b"VERSION .7\nFIELDS x y\n")
    with pytest.raises(ValueError, match="broken.pcd"):
        planish.read(broken)
    with pytest.raises((ValueError, OSError)):
        planish.write(tmp_path / "a.unknown", np.zeros((3, 3), np.float32))
    with pytest.raises(FileNotFoundError):
        planish.write(tmp_path / "none" / "a.pcd", np.zeros((3, 3), np.float32))
    with pytest.raises(ValueError, match="intensity"):
        planish.write(tmp_path / "a.pcd", np.zeros((3, 3), np.float32), fields={"intensity": np.zeros(2, np.float32)})
    with pytest.raises(TypeError, match="name"):
        planish.write(tmp_path / "a.pcd", np.zeros((2, 3), np.float32), fields={"name": np.array(["a", "b"])})
    with pytest.raises(ValueError):
        planish.write(tmp_path / "a.pcd", np.zeros((3, 4), np.float64))
    assert not (tmp_path / "a.pcd").exists()


def test_simulated_frames_and_scores_are_the_same_in_every_run():
    a, b = planish.simulate("shapes", seed=4), planish.simulate("shapes", seed=4)
    assert np.array_equal(a.depth, b.depth) and np.isfinite(a.points).any()
    with pytest.raises(ValueError, match="scene"):
        planish.simulate("garden")
    scores = planish.evaluate(seeds=[2], engine="cpu")
    raw, smoothed = (scores[of]["ranges"][0]["rmse_mm"] for of in ("raw", "smoothed"))
    assert smoothed < 0.3 * raw


def test_the_command_is_in_the_wheel(tmp_path):
    planish.write(tmp_path / "raw.pcd", planish.smooth(FRAME.depth, FRAME.camera, preset="paper", engine="cpu").points)
    run = [sys.executable, "-m", "planish"]
    done = subprocess.run([*run, "smooth", tmp_path / "raw.pcd", tmp_path / "out.pcd"], capture_output=True, text=True)
    assert done.returncode == 0 and planish.read(tmp_path / "out.pcd").points.shape == (480, 640, 3), done.stderr
    failed = subprocess.run([*run, "smooth", tmp_path / "none.pcd", tmp_path / "out.pcd"], capture_output=True, text=True)
    assert failed.returncode == 2 and "none.pcd" in failed.stderr
    assert "Usage: planish" in subprocess.run([*run, "--help"], capture_output=True, text=True).stdout


def test_devices_say_what_auto_takes():
    devices = planish.devices()
    assert devices.auto in ("cpu", "gpu") and devices.reason


def test_a_pipeline_keeps_bad_frames_and_says_why():
    frame = planish.simulate("table")
    bad = frame.depth[:10]
    smooth = SmoothFrames(frame.camera, engine="cpu")
    batch = smooth({"name": np.array(["a", "b", "c"]), "depth": [frame.depth, bad, frame.depth]})
    assert list(batch["name"]) == ["a", "b", "c"] and batch["smoothed"].dtype == np.uint16
    assert batch["error"][0] == "" and "640x480" in batch["error"][1] and not batch["smoothed"][1].any()
    assert np.array_equal(batch["smoothed"][0], batch["smoothed"][2]) and batch["smoothed"][0].any()
    points = SmoothFrames(frame.camera, engine="cpu", output="points")({"depth": [bad]})
    assert points["smoothed"].shape == (1, 480, 640, 3) and np.isnan(points["smoothed"]).all()
    with pytest.raises(KeyError, match="depth"):
        smooth({"name": []})
    with pytest.raises(ValueError, match="output"):
        SmoothFrames(frame.camera, output="mesh")


def test_a_pose_or_a_grid_that_a_format_has_no_place_for_is_said(tmp_path: Path) -> None:
    points = np.random.default_rng(1).random((4, 5, 3)).astype(np.float32)
    pose = (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)
    for suffix, lost in [(".las", "pose and the grid"), (".npz", "the sensor's pose;"), (".xyz", "pose and the grid")]:
        with pytest.warns(RuntimeWarning, match=lost):
            planish.write(tmp_path / f"a{suffix}", points, pose=pose)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for suffix in (".pcd", ".ply"):
            planish.write(tmp_path / f"a{suffix}", points, pose=pose)
            back = planish.read(tmp_path / f"a{suffix}")
            assert back.points.shape == (4, 5, 3) and np.allclose(back.pose, pose)


def test_an_archive_of_depth_and_intrinsics_has_a_camera(tmp_path):
    depth = np.full((48, 64), 2000, np.uint16)
    matrix = np.array([[52, 0, 31.5], [0, 52, 23.5], [0, 0, 1]])
    np.savez(tmp_path / "frame.npz", depth=depth, K=matrix)
    with pytest.warns(RuntimeWarning, match="array K"):
        frame = planish.read(tmp_path / "frame.npz")
    assert np.array_equal(frame.depth, depth)
    assert (frame.camera.fx, frame.camera.cx, frame.camera.width) == (52, 31.5, 64)
    for name, unusable in [("cam_intrinsics", matrix.astype("i4")), ("other", np.eye(3)), ("normal", np.ones((48, 64, 3), "f4"))]:
        np.savez(tmp_path / "frame.npz", **{"depth": depth, name: unusable})
        with pytest.warns(RuntimeWarning, match=name):
            frame = planish.read(tmp_path / "frame.npz")
        assert np.array_equal(frame.depth, depth)
        assert (frame.camera is not None) == (name == "cam_intrinsics")
    # Boxes and faces are not fields of the points.
    np.savez(tmp_path / "cloud.npz", pts=np.ones((1000, 3), "f4"), boxes=np.ones((7, 7), "f4"), faces=np.ones((2000, 3), "i4"))
    with pytest.warns(RuntimeWarning, match="faces"):
        frame = planish.read(tmp_path / "cloud.npz")
    assert frame.points.shape == (1000, 3) and not frame.fields


def test_units_and_columns_are_stated_or_guessed_with_a_warning(tmp_path):
    np.save(tmp_path / "mm.npy", np.array([[100, 200, 1000], [300, 0, 2000]], np.float32))
    with pytest.warns(RuntimeWarning, match="mm are converted to metres"):
        frame = planish.read(tmp_path / "mm.npy", unit="mm")
    assert np.allclose(frame.points, [[0.1, 0.2, 1], [0.3, 0, 2]])
    with pytest.raises(ValueError, match="mm, cm, m, inch or ft"):
        planish.read(tmp_path / "mm.npy", unit="furlong")
    rng = np.random.default_rng(1)
    scan = np.c_[rng.uniform(-20, 20, (500, 3)), rng.uniform(0, 1, 500)].astype(np.float32)
    scan.tofile(tmp_path / "scan.bin")
    with pytest.warns(RuntimeWarning, match="x y z intensity"):
        assert planish.read(tmp_path / "scan.bin").points.shape == (500, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(planish.read(tmp_path / "scan.bin", columns=4).fields["intensity"], scan[:, 3])


def test_guesses_about_a_camera_file_are_warnings(tmp_path):
    (tmp_path / "camera.json").write_text('{"width":64,"height":48,"fx":52,"fy":52,"cx":31.5,"cy":23.5,"depth_scale":0.1}')
    with pytest.warns(RuntimeWarning, match="10000 units per metre"):
        assert planish.Camera.read(tmp_path / "camera.json").depth_units_per_metre == 10000
