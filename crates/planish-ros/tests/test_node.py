"""Tests the node between an rclpy publisher and an rclpy subscriber, as between other ROS 2 nodes."""

import os
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from conftest import CAMERA, HEIGHT, PROJECTION, WIDTH, depth_mm, program, roughness
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(Path(__file__).parents[1] / "fastdds-one-machine.xml"))


class Robot:
    """A camera and a listener, which spin on a separate thread."""

    def __init__(self, namespace):
        self.node = rclpy.create_node("robot", namespace=namespace)
        self.received, self.spinning = {}, True
        self.thread = threading.Thread(target=self.spin)
        self.thread.start()

    def spin(self):
        while self.spinning:
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def listen(self, kind, topic):
        self.received[topic] = []
        self.node.create_subscription(kind, topic, self.received[topic].append, 5)

    def publish_until(self, sends, done, seconds=20):
        """Publishes the messages repeatedly until `done` returns true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for publisher, message in sends:
                publisher.publish(message)
            time.sleep(0.05)
            if done():
                return
        pytest.fail("no result arrived in time")

    def call(self, kind, service, request):
        client = self.node.create_client(kind, service)
        assert client.wait_for_service(20), service
        answer = client.call_async(request)
        end = time.monotonic() + 20
        while not answer.done() and time.monotonic() < end:
            time.sleep(0.02)
        return answer.result()

    def close(self):
        self.spinning = False
        self.thread.join()
        self.node.destroy_node()


@pytest.fixture
def robot(request):
    rclpy.init()
    robot = Robot("/" + request.node.originalname)
    yield robot
    robot.close()
    rclpy.shutdown()


@pytest.fixture
def start(robot):
    """Starts the node in the robot's namespace, and checks that it exits without an error when it is terminated."""
    nodes = []

    def started(*arguments):
        command = [program("planish-ros"), "--ros-args", "-r", f"__ns:={robot.node.get_namespace()}",
                   "-p", "engine:=cpu", *arguments]
        nodes.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
        return nodes[-1]

    yield started
    for node in nodes:
        node.terminate()
        assert node.wait(10) == 0


def image(depth, encoding="16UC1", frame="lens", second=7):
    message = Image(width=WIDTH, height=HEIGHT, encoding=encoding, step=depth.itemsize * WIDTH, data=depth.tobytes())
    message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec = frame, second, 123456789
    return message


def camera_info(width=WIDTH, height=HEIGHT):
    message = CameraInfo(width=width, height=height, distortion_model="plumb_bob", d=[0.0] * 5)
    message.k, message.p = CAMERA, PROJECTION
    return message


def test_depth_becomes_clouds_and_depth(robot, start):
    start("-p", "publish_depth:=true", "-p", "normals:=true", "-r", "image_rect:=depth/image_rect_raw",
          "-r", "camera_info:=depth/camera_info")
    robot.listen(PointCloud2, "points")
    robot.listen(Image, "image_smoothed")
    images = robot.node.create_publisher(Image, "depth/image_rect_raw", 5)
    infos = robot.node.create_publisher(CameraInfo, "depth/camera_info", 5)
    depth = depth_mm(1)
    clouds, smoothed = robot.received["points"], robot.received["image_smoothed"]
    robot.publish_until([(infos, camera_info()), (images, image(depth))], lambda: clouds and smoothed)
    cloud, result = clouds[-1], smoothed[-1]
    for header in (cloud.header, result.header):
        assert (header.frame_id, header.stamp.sec, header.stamp.nanosec) == ("lens", 7, 123456789)
    assert (cloud.width, cloud.height, cloud.point_step, cloud.is_dense) == (WIDTH, HEIGHT, 32, False)
    pixels = np.frombuffer(bytes(result.data), np.uint16).reshape(HEIGHT, WIDTH)
    assert result.encoding == "16UC1" and roughness(pixels) < 0.4 * roughness(depth)
    points = np.frombuffer(bytes(cloud.data), np.float32).reshape(HEIGHT, WIDTH, 8)
    assert np.nanmax(np.abs(1000 * points[..., 2] - pixels)[pixels > 0]) <= 0.51
    assert np.isnan(points[:, :4, :3]).all() and np.nanmax(points[..., 6]) < 0

    # Depth in metres stays in metres.
    smoothed.clear()
    metres = np.where(depth > 0, depth / 1000, np.nan).astype(np.float32)
    robot.publish_until([(infos, camera_info()), (images, image(metres, "32FC1"))],
                        lambda: smoothed and smoothed[-1].encoding == "32FC1")


def test_normals_are_images_of_their_own(robot, start):
    start("-p", "publish_normals:=true")
    robot.listen(PointCloud2, "points")
    robot.listen(Image, "normals")
    images = robot.node.create_publisher(Image, "image_rect", 5)
    infos = robot.node.create_publisher(CameraInfo, "camera_info", 5)
    clouds, normals = robot.received["points"], robot.received["normals"]
    sends = [(infos, camera_info()), (images, image(depth_mm(4)))]
    robot.publish_until(sends, lambda: clouds and normals)
    # Clouds do not contain these normals.
    assert clouds[-1].point_step == 16

    def check(message):
        assert (message.encoding, message.width, message.height, message.step) == ("32FC3", WIDTH, HEIGHT, 12 * WIDTH)
        assert (message.header.frame_id, message.header.stamp.sec) == ("lens", 7)
        pixels = np.frombuffer(bytes(message.data), np.float32).reshape(HEIGHT, WIDTH, 3)
        assert np.isnan(pixels[:, :4]).all() and np.isfinite(pixels).mean() > 0.9
        length = np.linalg.norm(pixels, axis=2)
        assert np.nanmax(np.abs(length - 1)) < 1e-5 and np.nanmax(pixels[..., 2]) < 0
        return pixels

    both = check(normals[-1])
    request = SetParameters.Request(parameters=[Parameter(name="publish_points", value=ParameterValue(
        type=ParameterType.PARAMETER_BOOL, bool_value=False))])
    service = f"{robot.node.get_namespace()}/planish/set_parameters"
    assert robot.call(SetParameters, service, request).results[0].successful
    clouds.clear()
    normals.clear()
    robot.publish_until(sends, lambda: len(normals) > 3)
    assert np.array_equal(check(normals[-1]), both, equal_nan=True) and len(clouds) <= 1


def test_parameters_are_listed_changed_and_refused(robot, start):
    start("-p", "strength:=0.25")
    name = f"{robot.node.get_namespace()}/planish"
    names = robot.call(ListParameters, f"{name}/list_parameters", ListParameters.Request()).result.names
    assert {"strength", "sensor", "edges", "publish_depth"} <= set(names)

    def change(parameter, value, kind):
        value = ParameterValue(type=kind, **{"double_value" if kind == ParameterType.PARAMETER_DOUBLE else "string_value": value})
        request = SetParameters.Request(parameters=[Parameter(name=parameter, value=value)])
        return robot.call(SetParameters, f"{name}/set_parameters", request).results[0]

    assert change("strength", 1.0, ParameterType.PARAMETER_DOUBLE).successful
    refused = change("strength", 2.0, ParameterType.PARAMETER_DOUBLE)
    assert not refused.successful and "strength" in refused.reason
    fixed = change("engine", "gpu", ParameterType.PARAMETER_STRING)
    assert not fixed.successful and "at startup" in fixed.reason
    assert change("sensor", "d435", ParameterType.PARAMETER_STRING).successful


def test_a_stronger_setting_takes_effect_while_the_node_runs(robot, start):
    start("-p", "publish_depth:=true", "-p", "publish_points:=false", "-p", "strength:=0.0")
    robot.listen(Image, "image_smoothed")
    images = robot.node.create_publisher(Image, "image_rect", 5)
    infos = robot.node.create_publisher(CameraInfo, "camera_info", 5)
    smoothed = robot.received["image_smoothed"]
    sends = [(infos, camera_info()), (images, image(depth_mm(2)))]
    robot.publish_until(sends, lambda: smoothed)
    light = bytes(smoothed[-1].data)
    request = SetParameters.Request(parameters=[Parameter(
        name="strength", value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=1.0))])
    service = f"{robot.node.get_namespace()}/planish/set_parameters"
    assert robot.call(SetParameters, service, request).results[0].successful
    robot.publish_until(sends, lambda: bytes(smoothed[-1].data) != light)


def test_clouds_keep_their_fields(robot, start):
    start("-p", "input:=points", "-r", "input:=cloud_in")
    robot.listen(PointCloud2, "points")
    clouds = robot.node.create_publisher(PointCloud2, "cloud_in", 5)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    z = depth_mm(3).astype(np.float32) / 1000
    z[z == 0] = np.nan
    points = np.zeros((HEIGHT, WIDTH, 8), np.float32)
    points[..., 0], points[..., 1], points[..., 2] = (u - CAMERA[2]) * z / CAMERA[0], (v - CAMERA[5]) * z / CAMERA[4], z
    points[..., 4] = np.arange(u.size, dtype=np.uint32).reshape(u.shape).view(np.float32)
    fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in [("x", 0), ("y", 4), ("z", 8), ("rgb", 16)]]
    cloud = PointCloud2(width=WIDTH, height=HEIGHT, fields=fields, point_step=32, row_step=32 * WIDTH, data=points.tobytes())
    robot.publish_until([(clouds, cloud)], lambda: robot.received["points"])
    result = robot.received["points"][-1]
    after = np.frombuffer(bytes(result.data), np.float32).reshape(HEIGHT, WIDTH, 8)
    assert (after.view(np.uint8)[..., 12:] == points.view(np.uint8)[..., 12:]).all()
    assert roughness(after[..., 2]) < 0.4 * roughness(z)


def test_bad_input_is_said_and_the_next_frame_is_smoothed(robot, start):
    node = start()
    robot.listen(PointCloud2, "points")
    images = robot.node.create_publisher(Image, "image_rect", 5)
    infos = robot.node.create_publisher(CameraInfo, "camera_info", 5)
    lines = []
    threading.Thread(target=lambda: lines.extend(iter(node.stderr.readline, "")), daemon=True).start()
    good = image(depth_mm(4))
    said = lambda text: any(text in line for line in lines)
    robot.publish_until([(images, good)], lambda: said("no CameraInfo on"))
    robot.publish_until([(infos, camera_info(64, 48)), (images, good)], lambda: said("64x48"))
    short = image(depth_mm(4))
    short.data = short.data[:100]
    robot.publish_until([(infos, camera_info()), (images, short)], lambda: said("100 bytes"))
    colour = image(depth_mm(4), "rgb8")
    robot.publish_until([(infos, camera_info()), (images, colour)], lambda: said("rgb8"))
    assert not robot.received["points"]
    robot.publish_until([(infos, camera_info()), (images, good)], lambda: robot.received["points"])
    # The same warning is not repeated for every frame.
    assert sum("rgb8" in line for line in lines) == 1


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_the_poses_of_a_moving_camera_are_taken(robot, start, poses):
    # The node also receives static transforms that were published before it started.
    publisher = subprocess.Popen([program("examples/publish_tf")], stdout=subprocess.PIPE) if poses == "tf" else None
    try:
        if publisher:
            assert publisher.stdout.readline() == b"published\n"
        node = start("-p", "temporal:=steady", "-p", f"poses:={poses}")
        robot.listen(PointCloud2, "points")
        images = robot.node.create_publisher(Image, "image_rect", 5)
        infos = robot.node.create_publisher(CameraInfo, "camera_info", 5)
        odometry = robot.node.create_publisher(Odometry, "odom", 5)
        lines = []
        threading.Thread(target=lambda: lines.extend(iter(node.stderr.readline, "")), daemon=True).start()
        unknown = lambda: [line for line in lines if "as if the camera stood still" in line]

        def frames(with_poses):
            """Publishes frames with the current time until three more clouds arrive."""
            before, end = len(robot.received["points"]), time.monotonic() + 20
            while len(robot.received["points"]) < before + 3:
                assert time.monotonic() < end, lines
                message = image(depth_mm(4))
                message.header.stamp = robot.node.get_clock().now().to_msg()
                infos.publish(camera_info())
                images.publish(message)
                if with_poses:
                    pose = Odometry(child_frame_id="lens")
                    pose.header.frame_id, pose.header.stamp = "odom", message.header.stamp
                    pose.pose.pose.orientation.w = 1.0
                    odometry.publish(pose)
                time.sleep(0.1)

        if poses == "odometry":
            frames(with_poses=False)
            assert any('"lens"' in line for line in unknown()), lines
        frames(with_poses=True)
        lines.clear()
        frames(with_poses=True)
        assert not unknown(), lines
        assert "frames" in [field.name for field in robot.received["points"][-1].fields]
    finally:
        if publisher:
            publisher.kill()
            publisher.wait()


def test_a_cloud_that_lies_about_its_size_does_not_end_the_node(robot, start):
    node = start("-p", "input:=points", "-p", "normals:=true", "-r", "input:=cloud_in")
    robot.listen(PointCloud2, "points")
    clouds = robot.node.create_publisher(PointCloud2, "cloud_in", 5)
    fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in [("x", 0), ("y", 4), ("z", 8)]]
    bad = PointCloud2(width=1, height=1, fields=fields, point_step=2**32 - 1, row_step=16, data=bytes(16))
    lines = []
    threading.Thread(target=lambda: lines.extend(iter(node.stderr.readline, "")), daemon=True).start()
    robot.publish_until([(clouds, bad)], lambda: any("4294967295" in line for line in lines))
    points = np.random.default_rng(1).normal(size=(500, 4)).astype(np.float32)
    good = PointCloud2(width=500, height=1, fields=fields, point_step=16, row_step=8000, data=points.tobytes())
    robot.publish_until([(clouds, good)], lambda: robot.received["points"])
    assert [field.name for field in robot.received["points"][-1].fields][3:] == ["normal_x", "normal_y", "normal_z", "curvature"]


def test_the_domain_of_the_environment_is_taken(robot, start, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    run = subprocess.run([program("planish-ros")], capture_output=True, text=True, timeout=20)
    assert run.returncode == 1 and "ROS_DOMAIN_ID" in run.stderr
    # In another domain the node cannot be found.
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    start()
    client = robot.node.create_client(ListParameters, f"{robot.node.get_namespace()}/planish/list_parameters")
    assert not client.wait_for_service(3)


def test_wrong_arguments_end_the_node_with_the_reason():
    for arguments, text in [(["--fast"], "--fast"), (["--ros-args", "-p", "strength:=7"], "strength"),
                            (["--ros-args", "-p", "speed:=7"], "speed"), (["--ros-args", "-r", "__ns:=x"], "slash"),
                            # The node would receive its own output forever.
                            (["--ros-args", "-p", "input:=points", "-r", "input:=/points"], "remap"),
                            # Without a driver there is no GPU.
                            (["--ros-args", "-p", "engine:=gpu"], "the engine cannot be opened")]:
        run = subprocess.run([program("planish-ros"), *arguments], capture_output=True, text=True, timeout=20,
                             env={**os.environ, "VK_DRIVER_FILES": "/nonexistent"})
        assert run.returncode == 1 and text in run.stderr, run.stderr
