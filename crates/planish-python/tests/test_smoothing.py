"""Smoothing from Python: accepted inputs, results, and rejected inputs."""

import multiprocessing
import os
import pickle
import signal
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

import planish
from planish import Smoothed, Smoother, Status


@pytest.fixture(scope="module")
def frame():
    return planish.simulate("table", seed=3)


@pytest.fixture(scope="module")
def cloud(frame):
    return planish.smooth(frame.depth, frame.camera, engine="cpu", outputs=["points"], preset="light").points


def test_depth_comes_out_smoother(frame):
    result = planish.smooth(frame.depth, frame.camera, outputs=["points", "normals", "curvature", "status", "neighbours", "depth", "depth_m"])
    valid = result.status >= Status.PLANE
    assert valid.mean() > 0.8 and np.isnan(result.points[result.status < Status.DEGENERATE]).all()
    raw = frame.depth[valid] / 1000.0
    truth, found = frame.points[valid][:, 2], result.points[valid][:, 2]
    near = np.isfinite(truth) & (np.abs(found - truth) < 0.05)
    assert np.std(found[near] - truth[near]) < 0.5 * np.std(raw[near] - truth[near])
    assert np.allclose(np.linalg.norm(result.normals[valid], axis=1), 1, atol=1e-5)
    assert np.allclose(result.depth_m[valid], found, atol=1e-6)
    assert np.abs(result.depth[valid] - 1000 * found).max() < 0.51
    assert result.neighbours[valid].min() >= 3 and (result.curvature[valid] <= 1 / 3).all()
    assert {name: getattr(result, name).dtype.name for name in ("points", "status", "neighbours", "depth")} == {
        "points": "float32", "status": "uint8", "neighbours": "uint32", "depth": "uint16"}


def test_metres_and_points_give_what_raw_depth_gives(frame, cloud):
    expected = planish.smooth(frame.depth, frame.camera, engine="cpu").points
    metres = np.where(frame.depth > 0, frame.depth.astype(np.float32) * np.float32(0.001), np.nan).astype(np.float32)
    found = planish.smooth(metres, frame.camera, engine="cpu").points
    assert np.allclose(found, expected, atol=2e-6, equal_nan=True)
    single = planish.smooth(cloud, engine="cpu").points
    double = planish.smooth(cloud.astype(np.float64), engine="cpu").points
    assert double.dtype == np.float64 and np.allclose(single, double, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("change", ["rows apart", "columns apart", "backwards", "upside down", "turned", "big-endian", "Fortran"])
def test_any_strides_and_byte_orders_give_the_same(frame, change):
    depth = np.ascontiguousarray(frame.depth[:120, :160])
    camera = planish.Camera(160, 120, 525.0, 525.0, 319.5, 239.5)
    expected = planish.smooth(depth, camera, engine="cpu").points
    if change == "rows apart":
        wide = np.full((120, 200), 7, np.uint16)
        wide[:, :160] = depth
        given = wide[:, :160]
    elif change == "columns apart":
        wide = np.full((120, 320), 7, np.uint16)
        wide[:, ::2] = depth
        given = wide[:, ::2]
    elif change == "backwards":
        given = np.ascontiguousarray(depth[:, ::-1])[:, ::-1]
    elif change == "upside down":
        given = np.ascontiguousarray(depth[::-1])[::-1]
    elif change == "turned":
        given = np.ascontiguousarray(depth.T).T
    elif change == "big-endian":
        given = depth.astype(">u2")
    else:
        given = np.asfortranarray(depth)
    assert np.array_equal(planish.smooth(given, camera, engine="cpu").points, expected, equal_nan=True)


def test_points_of_any_layout_give_the_same(cloud):
    expected = planish.smooth(cloud, engine="cpu").points
    padded = np.full((*cloud.shape[:2], 4), 9, np.float32)
    padded[..., :3] = cloud
    planes = np.ascontiguousarray(np.moveaxis(cloud, -1, 0))
    record = np.zeros(cloud.shape[:2], [("x", "f4"), ("rgb", "u4"), ("y", "f4"), ("z", "f4")])
    record["x"], record["y"], record["z"] = np.moveaxis(cloud, -1, 0)
    for given in (padded[..., :3], np.moveaxis(planes, 0, -1), cloud[::-1][::-1], record):
        assert np.array_equal(planish.smooth(given, engine="cpu").points, expected, equal_nan=True)


def test_general_clouds_keep_their_order_and_their_digits(cloud):
    points = cloud[np.isfinite(cloud).all(axis=-1)][::7].astype(np.float64)
    near = planish.smooth(points, engine="cpu")
    far = points + [637_000.0, 4_849_000.0, 120.0]
    moved = planish.smooth(far, engine="cpu").points
    assert np.abs(moved - [637_000.0, 4_849_000.0, 120.0] - near.points).max() < 1e-4
    assert (near.status >= Status.PLANE).mean() > 0.95
    holes = points.copy()
    holes[5] = np.nan
    assert planish.smooth(holes, engine="cpu").status[5] == Status.HOLE
    assert planish.smooth(np.empty((0, 3), np.float32), engine="cpu").points.shape == (0, 3)


def test_own_arrays_are_written_into(frame):
    smoother = Smoother(frame.camera, engine="cpu")
    expected = smoother.smooth(frame.depth)
    arrays = {"points": np.empty((480, 640, 3), np.float32), "status": np.empty((480, 640), np.uint8)}
    found = smoother.smooth(frame.depth, out=arrays)
    assert found.points is arrays["points"] and found.normals is None
    assert np.array_equal(arrays["points"], expected.points, equal_nan=True)
    assert np.array_equal(arrays["status"], expected.status)
    again = smoother.smooth(frame.depth, out=Smoothed(points=arrays["points"]))
    assert again.points is arrays["points"]


def test_batches_and_frames_in_flight_give_what_single_frames_give(frame):
    frames = np.stack([planish.simulate("table", seed=3, index=i).depth for i in range(5)])
    smoother = Smoother(frame.camera, outputs=["depth", "status", "neighbours"], engine="cpu")
    expected = np.stack([smoother.smooth(depth).depth for depth in frames])
    batch = smoother.smooth_batch(frames)
    assert np.array_equal(batch.depth, expected) and batch.neighbours.shape == (5, 480, 640)
    out = np.empty_like(frames)
    assert smoother.smooth_batch(list(frames), out={"depth": out}).depth is out and np.array_equal(out, expected)
    received = []
    for depth in frames:
        if smoother.in_flight == smoother.max_in_flight:
            received.append(smoother.receive().depth)
        smoother.submit(depth)
    with pytest.raises(RuntimeError, match="in flight"):
        smoother.smooth(frames[0])
    while (result := smoother.receive()) is not None:
        received.append(result.depth)
    assert np.array_equal(np.stack(received), expected)


def test_the_gpu_engine_gives_the_same(frame):
    if not planish.devices().gpus:
        pytest.skip("no Vulkan device")
    expected = planish.smooth(frame.depth, frame.camera, engine="cpu").points
    # A software renderer is used only if it is selected by index.
    smoother = Smoother(frame.camera, engine="gpu", adapter=0, outputs=["points"])
    found = smoother.smooth(frame.depth).points
    assert smoother.engine.startswith("gpu, ")
    assert np.nanquantile(np.abs(found - expected), 0.999) < 1e-5
    assert np.array_equal(smoother.smooth_batch([frame.depth] * 5).points[4], found, equal_nan=True)


def test_python_goes_on_while_frames_are_smoothed(frame):
    smoother = Smoother(frame.camera, engine="reference", threads=1, outputs=["points"])
    counted, is_done = 0, threading.Event()

    def work():
        smoother.smooth(frame.depth[:, :])
        is_done.set()

    worker = threading.Thread(target=work)
    worker.start()
    while not is_done.is_set():
        counted += 1
    worker.join()
    assert counted > 1000


def test_two_threads_cannot_share_a_smoother(frame):
    smoother = Smoother(frame.camera, engine="reference", threads=1, outputs=["points"])
    errors, results, begin = [], [], threading.Barrier(2)

    def work():
        begin.wait()
        try:
            results.append(smoother.smooth(frame.depth).points)
        except RuntimeError as error:
            errors.append(str(error))

    workers = [threading.Thread(target=work) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(results) == 1 and "one Smoother per thread" in errors[0]


def test_smoothers_are_pickled_without_their_buffers(frame):
    smoother = Smoother(frame.camera, preset="strong", engine="cpu", outputs=["depth"])
    expected = smoother.smooth(frame.depth).depth
    copied = pickle.loads(pickle.dumps(smoother))
    assert repr(copied) == repr(smoother) and "strong" in repr(copied)
    assert np.array_equal(copied.smooth(frame.depth).depth, expected)
    camera = planish.Camera(64, 48, 50.0, 50.0, depth_units_per_metre=5000.0, distortion=[0.1, 0.0, 0.0, 0.0, 0.02])
    assert pickle.loads(pickle.dumps(camera)) == camera


def test_what_has_array_protocols_is_taken(frame, cloud):
    class Dlpack:
        def __dlpack_device__(self):
            return (1, 0)

        def __dlpack__(self, **kwargs):
            return frame.depth.__dlpack__(**kwargs)

    class Interface:
        __array_interface__ = frame.depth.__array_interface__

    class OnDevice:
        def __dlpack_device__(self):
            return (2, 0)

        def __dlpack__(self, **kwargs):
            raise BufferError

        def cpu(self):
            return frame.depth

    expected = planish.smooth(frame.depth, frame.camera, engine="cpu").points
    for given in (Dlpack(), Interface()):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.array_equal(planish.smooth(given, frame.camera, engine="cpu").points, expected, equal_nan=True)
    with pytest.warns(UserWarning, match="copied to the host"):
        planish.smooth(OnDevice(), frame.camera, engine="cpu")


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (lambda d: d.astype(np.int32), TypeError, "int32.*uint16.*float32"),
        (lambda d: d.astype(np.complex64), TypeError, "complex64"),
        (lambda d: d[None, None], ValueError, r"\[1, 1, 480, 640\]"),
        (lambda d: d[:100], ValueError, "640x480"),
        (lambda d: np.empty((0, 640), np.uint16), ValueError, "no pixels"),
        (lambda d: np.zeros((5, 3), np.int64), TypeError, "int64"),
        (lambda d: np.zeros(4, [("a", "f4")]), TypeError, "x, y and z"),
        (lambda d: np.array(["a"]), (TypeError, ValueError), "shape"),
    ],
)
def test_wrong_arrays_are_refused(frame, change, error, text):
    with pytest.raises(error, match=text):
        planish.smooth(change(frame.depth), frame.camera)


@pytest.mark.parametrize(
    ("settings", "error", "text"),
    [
        ({"window": 9}, ValueError, "window = 9.*1 to 7"),
        ({"degree": 0}, ValueError, "degree"),
        ({"degree": 2.5}, ValueError, "degree"),
        ({"window": -1}, ValueError, "window"),
        ({"ridge": float("nan")}, ValueError, "ridge"),
        ({"radius": -1.0}, ValueError, "radius"),
        ({"radius": 0.1, "neighbours": 40}, ValueError, "set either"),
        ({"preset": "soft"}, ValueError, 'light, default'),
        ({"preset": "light", "strength": 0.5}, ValueError, "set either"),
        ({"strength": 2.0}, ValueError, "strength"),
        ({"sensor": "kinect9"}, ValueError, 'auto'),
        ({"engine": "tpu"}, ValueError, 'gpu'),
        ({"edges": "maybe"}, ValueError, 'robust'),
        ({"outputs": ["point"]}, ValueError, "'point'"),
        ({"outputs": "points"}, TypeError, "list"),
        ({"outputs": []}, ValueError, "none"),
        ({"threads": 0}, ValueError, "threads"),
        ({"colour": "red"}, TypeError, "colour"),
    ],
)
def test_wrong_settings_are_refused(frame, settings, error, text):
    with pytest.raises(error, match=text):
        planish.smooth(frame.depth, frame.camera, **settings)


def test_wrong_outputs_are_refused(frame):
    smoother = Smoother(frame.camera, engine="cpu")
    points = np.empty((480, 640, 3), np.float32)
    read_only = points.copy()
    read_only.flags.writeable = False
    depth = frame.depth.copy()
    for out, error, text in [
        ({"points": points.astype(np.float64)}, TypeError, "float32"),
        ({"points": points[:100]}, ValueError, r"\[480, 640, 3\]"),
        ({"points": read_only}, ValueError, "read-only"),
        ({"points": np.empty((480, 640, 4), np.float32)[..., :3]}, ValueError, "contiguous"),
        ({"points": points, "normals": points}, ValueError, "overlap"),
        ({"depth": depth}, ValueError, "overlap"),
        ({"colour": points}, ValueError, "colour"),
        ({"points": [1, 2]}, TypeError, "list"),
        (points, TypeError, "dict"),
    ]:
        with pytest.raises(error, match=text):
            smoother.smooth(depth, out=out)


def test_wrong_cameras_and_poses_are_refused(frame):
    for arguments in [(0, 480, 525.0, 525.0), (640, 480, float("nan"), 525.0), (640, 480, -1.0, 525.0)]:
        with pytest.raises(ValueError):
            planish.Camera(*arguments)
    with pytest.raises(ValueError, match="4 .*, 5 .* or 8"):
        planish.Camera(640, 480, 525.0, 525.0, distortion=[1.0])
    with pytest.raises(ValueError, match="camera"):
        planish.smooth(frame.depth)
    with pytest.raises(TypeError, match="Camera"):
        planish.smooth(frame.depth, (640, 480))
    with pytest.raises(ValueError, match="7 numbers"):
        planish.smooth(frame.points, pose=[0, 0, 0])
    with pytest.raises(ValueError, match="pose"):
        planish.smooth(frame.depth, frame.camera, pose=[0, 0, 0, 1, 0, 0, 0])
    with pytest.raises(FileNotFoundError):
        planish.Camera.read("/nowhere/camera.yaml")


def test_points_of_one_row_may_run_backwards(cloud):
    points = cloud[np.isfinite(cloud).all(axis=-1)][:50]
    assert planish.smooth(points[:1][::-1]).points.shape == (1, 3)
    assert planish.smooth(points[::-1][:0]).points.shape == (0, 3)
    row = planish.smooth(cloud[200:201][::-1], engine="cpu", radius=0.05).points
    assert np.array_equal(row, planish.smooth(cloud[200:201], engine="cpu", radius=0.05).points, equal_nan=True)


def test_a_stray_point_costs_others_no_digits(cloud):
    points = cloud[np.isfinite(cloud).all(axis=-1)][::9].astype(np.float64) + [698_011.0, 6_259_973.0, 96.0]
    # Without the setting, the number of neighbours is chosen from samples, which one more point shifts.
    alone = planish.smooth(points, engine="cpu", neighbours=40).points
    both = planish.smooth(np.vstack([[0, 0, 0], points]), engine="cpu", neighbours=40).points
    assert np.abs(both[1:] - alone).max() < 1e-5 and np.array_equal(both[0], [0, 0, 0])


def test_batches_of_doubles_and_of_generators(cloud, frame):
    far = np.stack([cloud.astype(np.float64) + [698_011.0, 0, 0]] * 2)
    smoother = Smoother(engine="cpu", outputs=["points"])
    batch = smoother.smooth_batch(far).points
    assert batch.dtype == np.float64 and np.array_equal(batch[1], smoother.smooth(far[0]).points, equal_nan=True)

    def reused():
        buffer = np.empty_like(frame.depth)
        for i in range(3):
            buffer[:] = frame.depth // (i + 1)
            yield buffer

    smoother = Smoother(frame.camera, engine="cpu", outputs=["depth"])
    batch = smoother.smooth_batch(reused()).depth
    assert np.array_equal(batch[0], smoother.smooth(frame.depth).depth) and not np.array_equal(batch[0], batch[2])


def test_what_is_masked_is_a_hole(frame):
    masked = np.ma.masked_greater(frame.depth, 2000)
    result = planish.smooth(masked, frame.camera, engine="cpu")
    assert (result.status[masked.mask] == Status.HOLE).all() and (result.status >= Status.PLANE).any()


def test_memory_that_is_shared_otherwise_overlaps_too(frame):
    shared = bytearray(frame.depth.tobytes())
    depth, out = (np.frombuffer(shared, np.uint16).reshape(480, 640) for _ in range(2))
    with pytest.raises(ValueError, match="overlaps"):
        Smoother(frame.camera).smooth(depth, out={"depth": out})


def test_frames_in_flight_are_never_mixed_with_others(cloud):
    smoother = Smoother(engine="cpu", outputs=["points"])
    smoother.submit(cloud)
    with pytest.raises(RuntimeError, match="in flight"):
        smoother.submit(cloud * np.float32([3, 3, 1]))
    assert np.array_equal(smoother.receive().points, planish.smooth(cloud, engine="cpu").points, equal_nan=True)
    assert smoother.receive() is None


def test_a_smoother_remembers_nothing_of_earlier_frames(cloud):
    wide = cloud * np.float32([3, 3, 1])
    smoother = Smoother(engine="cpu", outputs=["points"])
    smoother.smooth(wide)
    assert np.array_equal(smoother.smooth(cloud).points, planish.smooth(cloud, engine="cpu").points, equal_nan=True)


def _in_child(smoother, depth, queue):
    again = planish.smooth(depth, smoother.camera, engine="cpu", outputs=["depth"]).depth
    queue.put((smoother.smooth(depth).depth, again))


@pytest.mark.parametrize(("method", "temporal"), [("fork", "off"), ("fork", "steady"), ("spawn", "steady")])
def test_processes_that_are_forked_or_spawned_go_on(frame, method, temporal):
    smoother = Smoother(frame.camera, engine="cpu", outputs=["depth"], threads=2, temporal=temporal)
    expected = smoother.smooth(frame.depth).depth
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(smoother, frame.depth, queue))
    child.start()
    try:
        for found in queue.get(timeout=60):
            assert np.array_equal(found, expected)
    finally:
        child.kill()
        child.join()
    again = smoother.smooth(frame.depth).depth
    # The mean of two equal frames may differ from them by a rounding error.
    assert np.array_equal(again, expected) if temporal == "off" else np.abs(again - expected.astype(int)).max() <= 1


def _points_in_child(smoother, points, queue):
    queue.put(smoother.smooth(points).points)


def test_a_forked_process_chooses_neighbours_too():
    points = np.random.default_rng(1).random((3000, 3)).astype(np.float32) * np.float32([1, 1, 0.01])
    smoother = Smoother(engine="cpu", outputs=["points"], threads=2)
    expected = smoother.smooth(points).points
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_points_in_child, args=(smoother, points, queue))
    child.start()
    try:
        assert np.array_equal(queue.get(timeout=60), expected)
    finally:
        child.kill()
        child.join()


def test_ctrl_c_ends_one_long_cloud() -> None:
    rng = np.random.default_rng(1)
    # Smoothing takes seconds: each point has thousands of neighbours.
    points = rng.random((400_000, 3)).astype(np.float32)
    smoother = planish.Smoother(outputs=["points"], engine="cpu", threads=1, radius=0.12, degree=3)
    # Processes that a shell started in the background ignore the signal, so set the default handler.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    sender = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    sender.start()
    start = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            smoother.smooth(points)
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - start < 3
    # The smoother continues with the next frame.
    assert np.isfinite(smoother.smooth(points[:2000]).points).all()


def test_settings_that_change_nothing_for_a_general_cloud_are_said_once() -> None:
    points = np.random.default_rng(1).random((500, 3)).astype(np.float32)
    with planish.Smoother(preset="strong", stride=2, neighbours=20, engine="cpu") as smoother:
        with pytest.warns(RuntimeWarning, match="stride, preset have no effect"):
            smoother.smooth(points)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smoother.smooth(points)
            planish.smooth(points, neighbours=20, edges="robust", degree=1, engine="cpu")


def test_the_choice_for_a_cloud_and_even_spacing() -> None:
    random = np.random.default_rng(1)
    directions = random.normal(size=(4000, 3))
    sphere = directions / np.linalg.norm(directions, axis=1)[:, None] + random.normal(scale=0.03, size=(4000, 3))
    smoother = Smoother(engine="cpu", outputs=["points"])
    plain = smoother.smooth(sphere).points
    choice = smoother.cloud_choice
    assert choice.edges == "off" and choice.neighbours >= 40 and choice.noise_m == pytest.approx(0.03, rel=0.15)
    even = planish.smooth(sphere, engine="cpu", outputs=["points"], even=True).points
    apart = [np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1] for points in (plain, even)]
    # In an evenly spaced cloud, the distances to the nearest neighbours are similar everywhere.
    assert apart[1].std() / apart[1].mean() < 0.85 * apart[0].std() / apart[0].mean()
    assert np.abs(np.linalg.norm(even, axis=1) - 1).mean() < 1.1 * np.abs(np.linalg.norm(plain, axis=1) - 1).mean()
    with Smoother(engine="cpu", neighbours=40) as given:
        given.smooth(sphere)
        assert given.cloud_choice is None and given.rebuilt_grid is None
    frame = planish.simulate("table", seed=3)
    points = planish.smooth(frame.depth, frame.camera, engine="cpu", preset="light").points
    smoother.smooth(points[np.isfinite(points[..., 2])])
    assert smoother.cloud_choice is None and smoother.rebuilt_grid == (480, 640)


def test_settings_of_a_file_are_keyword_arguments(tmp_path: Path) -> None:
    frame = planish.simulate("table")
    file = tmp_path / "wall.yaml"
    file.write_text("preset: strong\nedges: off\nradius_m: 0.05\n")
    settings = planish.read_settings(file)
    assert settings["preset"] == "strong" and settings["edges"] == "off"
    given = planish.smooth(frame.depth, frame.camera, engine="cpu", preset="strong", edges="off", radius=0.05)
    read = planish.smooth(frame.depth, frame.camera, engine="cpu", **settings)
    assert np.array_equal(given.points, read.points, equal_nan=True)
    written = tmp_path / "again.json"
    planish.write_settings(written, settings)
    assert planish.read_settings(written) == settings
    file.write_text("window: 9")
    with pytest.raises(ValueError, match=r"wall\.yaml.*window = 9 is not allowed: 1 to 7"):
        planish.read_settings(file)
    with pytest.raises(ValueError, match="1 to 7"):
        planish.write_settings(written, {"window": 9})
