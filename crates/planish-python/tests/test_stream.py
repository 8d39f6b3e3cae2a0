"""Streams: every frame of a folder, the newest frame of a camera, errors, and the end of a stream."""

import gc
import os
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import planish
import pytest

CAMERA = planish.Camera(160, 120, fx=131.25, fy=131.25)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(6):
        frame = planish.simulate("table", camera=CAMERA, seed=seed)
        planish.write(tmp_path / f"frame{seed}.png", frame.depth)
    return tmp_path


def test_every_frame_of_a_folder_comes_in_order_and_as_a_smoother_makes_it(folder: Path) -> None:
    with planish.stream(folder, CAMERA, outputs=["depth", "points", "normals", "status"], engine="cpu") as frames:
        assert not frames.is_live and frames.statistics is None
        found = list(frames)
    assert [frame.name for frame in found] == [f"frame{seed}" for seed in range(6)]
    assert [frame.index for frame in found] == list(range(6))
    with planish.Smoother(CAMERA, outputs=["depth", "points", "normals", "status"], engine="cpu") as smoother:
        for frame in found:
            assert frame.camera == CAMERA and frame.points is None and frame.latency_s > 0
            expected = smoother.smooth(frame.depth)
            for name in ("depth", "points", "normals", "status"):
                ours, theirs = getattr(frame.smoothed, name), getattr(expected, name)
                assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
                np.testing.assert_array_equal(ours, theirs)
    statistics = frames.statistics
    assert statistics is not None
    assert (statistics["frames_in"], statistics["frames_out"], statistics["dropped"]) == (6, 6, 0)
    assert statistics["engine"] == "cpu" and statistics["latency_p50_s"] > 0


def test_slow_consumers_lose_frames_of_a_camera_only(folder: Path) -> None:
    with planish.stream(folder, CAMERA, engine="cpu") as frames:
        assert sum(time.sleep(0.05) is None for _ in frames) == 6
    with planish.stream(folder, CAMERA, fps=100.0, engine="cpu", outputs=["depth"]) as frames:
        assert frames.is_live
        first = next(frames)
        time.sleep(0.4)
        rest = [frame.name for frame in frames]
    # The waiting frame is the newest.
    assert first.index < 6 and rest[-1:] == ["frame5"][: len(rest)] and len(rest) <= 2
    statistics = frames.statistics
    assert statistics is not None and statistics["dropped"] >= 6 - 1 - len(rest)


def test_a_stream_can_be_left_at_any_frame(folder: Path) -> None:
    before = threading.active_count()
    for _ in range(3):
        with planish.stream("synthetic", frames=None, outputs=["depth"]) as frames:
            assert next(frames).smoothed.depth is not None
    left = planish.stream(folder, CAMERA)
    next(left)
    del left
    gc.collect()
    assert threading.active_count() == before
    with planish.stream(folder, CAMERA, frames=2) as frames:
        assert len(list(frames)) == 2
        with pytest.raises(StopIteration):
            next(frames)


def test_a_warning_made_an_error_costs_no_frame(folder: Path) -> None:
    (folder / "frame0.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    names, warned = [], 0
    with planish.stream(folder, CAMERA, outputs=["depth"]) as frames, warnings.catch_warnings():
        warnings.simplefilter("error")
        while True:
            try:
                names.append(next(frames).name)
            except RuntimeWarning:
                warned += 1
            except StopIteration:
                break
    assert names == [f"frame{seed}" for seed in range(1, 6)] and warned == 1


def test_a_stream_ends_at_once_and_belongs_to_its_process(folder: Path) -> None:
    with planish.stream(folder, CAMERA, fps=0.1, outputs=["depth"]) as frames:
        next(frames)
        start = time.monotonic()
    assert time.monotonic() - start < 2
    (folder / "frame1.png").unlink()
    with planish.stream(folder / "frame0.png", outputs=["depth"]) as frames:
        with pytest.raises(ValueError, match="camera"):
            list(frames)
    with planish.stream(folder, CAMERA) as frames:
        child = os.fork()
        if child == 0:
            try:
                next(frames)
            except RuntimeError:
                frames.close()
                os._exit(7)
            os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert len(list(frames)) == 5


def test_clouds_come_with_their_points(tmp_path: Path) -> None:
    frame = planish.simulate("room", camera=CAMERA, seed=1)
    planish.write(tmp_path / "a.pcd", planish.smooth(frame.depth, CAMERA, outputs=["points"]).points)
    (found,) = planish.stream(tmp_path, outputs=["points", "normals"])
    assert found.depth is None and found.points is not None and found.points.shape == (120, 160, 3)
    assert found.smoothed.normals is not None and found.smoothed.normals.shape == (120, 160, 3)


def test_what_is_wrong_is_said(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        planish.stream(tmp_path / "none")
    with pytest.raises(ValueError, match=r"frame0\.png.*camera"):
        planish.stream(folder)
    with pytest.raises(ValueError, match="outputs"):
        planish.stream(folder, CAMERA, outputs=["colour"])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="frames"):
        planish.stream(folder, CAMERA, frames=-1)
    with pytest.raises(TypeError, match=r"planish\.Camera"):
        planish.stream(folder, "camera")  # type: ignore[arg-type]
    (folder / "frame3.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    with pytest.warns(RuntimeWarning, match="frame3"):
        names = [frame.name for frame in planish.stream(folder, CAMERA)]
    assert names == ["frame0", "frame1", "frame2", "frame4", "frame5"]


def test_a_recording_of_a_realsense_streams_by_the_library_in_pyrealsense2(tmp_path: Path) -> None:
    rs = pytest.importorskip("pyrealsense2")
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Software D435")
    device.register_info(rs.camera_info.serial_number, "000123")
    stream = rs.video_stream()
    stream.type, stream.fmt = rs.stream.depth, rs.format.z16
    stream.width, stream.height, stream.fps, stream.bpp = 160, 120, 30, 2
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = 160, 120, CAMERA.fx, CAMERA.fy
    intrinsics.ppx, intrinsics.ppy = CAMERA.cx, CAMERA.cy
    intrinsics.model, intrinsics.coeffs = rs.distortion.brown_conrady, [0] * 5
    stream.intrinsics = intrinsics
    sensor = device.add_sensor("Stereo Module")
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, 0.001)
    file = tmp_path / "walk.db3"
    recorder = rs.recorder(str(file), device)
    recorded = recorder.query_sensors()[0]
    recorded.open(recorded.get_stream_profiles()[0])
    recorded.start(rs.frame_queue(1))
    depths = [planish.simulate("table", camera=CAMERA, seed=seed).depth for seed in range(4)]
    for number, depth in enumerate(depths, 1):
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = depth, 2 * 160, 2
        frame.timestamp, frame.domain = 1000.0 * number, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile, frame.depth_units = number, profile.as_video_stream_profile(), 0.001
        sensor.on_video_frame(frame)
        time.sleep(0.02)
    time.sleep(0.2)
    recorded.stop()
    recorded.close()
    del recorded, recorder
    gc.collect()

    with planish.stream(f"realsense:{file}", outputs=["depth"], engine="cpu") as frames:
        found = list(frames)
    assert [frame.timestamp_s for frame in found] == [1.0, 2.0, 3.0, 4.0]
    for frame, depth in zip(found, depths, strict=True):
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.depth, depth)
        assert frame.camera == CAMERA
    with pytest.raises(ValueError, match="align"):
        planish.stream(f"realsense:{file}", align="colour")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="848x480@30"):
        planish.stream(f"realsense:{file}", mode="large")


def test_a_video_of_a_camera_at_rest() -> None:
    random = np.random.default_rng(2)
    camera = planish.Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    frames = [(2000 + 7 * random.normal(size=(120, 160))).astype(np.uint16) for _ in range(20)]
    deviations = {}
    for temporal in ("off", "steady"):
        with planish.Smoother(camera, outputs=["depth_m", "status"], temporal=temporal, engine="cpu") as smoother:
            results = [smoother.smooth(frame).depth_m for frame in frames]
            assert (smoother.smooth(frames[0]).status != planish.Status.HOLE).all()
            smoother.restart_video()
            np.testing.assert_array_equal(smoother.smooth(frames[0]).depth_m, results[0])
        deviations[temporal] = np.std(np.diff(results[10:], axis=0))
    assert deviations["steady"] < 0.3 * deviations["off"], deviations
    with planish.Smoother(camera, outputs=["points", "frames"], temporal="steady") as smoother:
        counts = [smoother.smooth(frame).frames for frame in frames]
    assert counts[0].max() == 1 and counts[-1].dtype == np.float32
    assert counts[-1].shape == (120, 160) and np.median(counts[-1]) > 10
    with planish.Smoother(camera, outputs=["frames"]) as smoother, pytest.raises(ValueError, match="temporal"):
        smoother.smooth(frames[0])
    with pytest.raises(ValueError, match="off or steady"):
        planish.Smoother(camera, temporal="often")  # type: ignore[arg-type]
    assert planish.Status.CARRIED == 7


def test_a_video_of_a_moving_camera() -> None:
    # A camera approaches a wall by 4 mm per frame. With its poses, the noise is averaged over time.
    random = np.random.default_rng(2)
    camera = planish.Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    distances = 2 - 0.004 * np.arange(20)
    frames = [(1000 * distance + 7 * random.normal(size=(120, 160))).astype(np.uint16) for distance in distances]
    poses = [(0, 0, 2 - distance, 1, 0, 0, 0) for distance in distances]
    deviations = {}
    for name, settings, has_poses in (
        ("off", {}, False),
        ("poses", {"temporal": "steady"}, True),
        ("track", {"track": True}, False),
    ):
        with planish.Smoother(camera, outputs=["depth_m"], engine="cpu", **settings) as smoother:  # type: ignore[arg-type]
            for frame, pose in zip(frames, poses, strict=True):
                found = smoother.smooth(frame, camera_pose=pose if has_poses else None).depth_m
            motion = smoother.camera_motion
        deviations[name] = np.std(found - distances[-1])
        assert abs(np.mean(found - distances[-1])) < 1e-3
        assert (motion is None) == (name == "off")
        if motion is not None:
            assert abs(motion[2] - 0.004) < 1e-3 and motion[3] > 0.999
    assert deviations["poses"] < 0.5 * deviations["off"], deviations
    assert deviations["track"] < 0.6 * deviations["off"], deviations
    with planish.Smoother(camera, outputs=["depth_m"]) as smoother, pytest.raises(ValueError, match="temporal"):
        smoother.smooth(frames[0], camera_pose=poses[0])
    with planish.Smoother(camera, temporal="steady") as smoother, pytest.raises(ValueError, match="7 numbers"):
        smoother.smooth(frames[0], camera_pose=poses[0][:3])
    with pytest.warns(RuntimeWarning, match="track: no effect on a single frame"):
        planish.smooth(frames[0], camera, track=True)


def test_poses_of_a_moving_camera_are_used_and_their_lack_is_counted(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    poses = tmp_path_factory.mktemp("poses") / "trajectory.log"
    pose = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    poses.write_text("".join(f"{frame} {frame} {frame + 1}\n{pose}" for frame in range(5)))
    with planish.stream(folder, CAMERA, temporal="steady", poses=poses, outputs=["depth", "frames"]) as frames:
        assert len(list(frames)) == 6
    statistics = frames.statistics
    assert statistics is not None and statistics["without_pose"] == 1
    with pytest.raises(ValueError, match="poses need smoothing over time"):
        planish.stream(folder, CAMERA, poses=poses)
    with pytest.raises(ValueError, match="cannot be combined"):
        planish.stream(folder, CAMERA, temporal="steady", poses=poses, pose_topic="/tf")
    with pytest.raises(ValueError, match="no effect without pose_topic"):
        planish.stream(folder, CAMERA, temporal="steady", fixed_frame="odom")
    with pytest.raises((ValueError, OSError), match=str(folder)):
        planish.stream(folder, CAMERA, temporal="steady", pose_topic="/tf")
