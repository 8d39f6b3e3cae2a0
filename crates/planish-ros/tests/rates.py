"""Publishes depth at 30 Hz with rclpy, lets the node smooth it, and measures the results.

    rates.py NODE [--seconds 60] [--depth] [--best-effort] [--parameter NAME:=VALUE ...]

The publisher and the subscriber are separate processes, as on a robot. Prints the frame rate and the latencies
from stamp to arrival.
"""

import argparse
import json
import multiprocessing as mp
import os
import subprocess
import sys
import time

WIDTH, HEIGHT, HZ = 640, 480, 30


def publish(seconds, ready):
    import numpy as np
    import rclpy
    from sensor_msgs.msg import CameraInfo, Image

    rclpy.init(args=[])
    node = rclpy.create_node("camera")
    images = node.create_publisher(Image, "image_rect", 5)
    infos = node.create_publisher(CameraInfo, "camera_info", 5)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    z = 1.2 + 0.3 * u / WIDTH + 0.1 * np.sin(v / 40)
    rng = np.random.default_rng(1)
    frames = [np.round(1000 * (z + rng.normal(size=z.shape) * 0.002)).astype(np.uint16).tobytes() for _ in range(4)]
    info = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", d=[0.0] * 5)
    info.k = [525.0, 0.0, 319.5, 0.0, 525.0, 239.5, 0.0, 0.0, 1.0]
    info.p = [525.0, 0.0, 319.5, 0.0, 0.0, 525.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    image = Image(width=WIDTH, height=HEIGHT, encoding="16UC1", step=2 * WIDTH)
    image.header.frame_id = info.header.frame_id = "lens"
    for _ in range(100):
        if images.get_subscription_count() and infos.get_subscription_count():
            break
        time.sleep(0.1)
    time.sleep(1)
    ready.set()
    start, sent = time.monotonic(), 0
    while sent < seconds * HZ:
        time.sleep(max(0, start + sent / HZ - time.monotonic()))
        image.header.stamp = info.header.stamp = node.get_clock().now().to_msg()
        image.data = frames[sent % 4]
        infos.publish(info)
        images.publish(image)
        sent += 1
    time.sleep(1)
    rclpy.shutdown()


def receive(depth, reliable, ready, stop, results):
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image, PointCloud2

    rclpy.init(args=[])
    node = rclpy.create_node("listener")
    latencies, last = [], []

    def on_message(message):
        stamp = message.header.stamp
        latencies.append(time.time() - stamp.sec - 1e-9 * stamp.nanosec)
        last[:] = [message.header.frame_id, message.width, message.height]

    policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    qos = QoSProfile(depth=5, reliability=policy)
    node.create_subscription(Image if depth else PointCloud2, "image_smoothed" if depth else "points", on_message, qos)
    while not stop.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    results.put((latencies, last))
    rclpy.shutdown()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("node")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--depth", action="store_true")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--parameter", action="append", default=[], metavar="NAME:=VALUE")
    args = parser.parse_args()
    context = mp.get_context("spawn")
    ready, stop, results = context.Event(), context.Event(), context.Queue()
    command = [args.node, "--ros-args", "-p", "engine:=cpu"]
    if args.depth:
        command += ["-p", "publish_depth:=true", "-p", "publish_points:=false"]
    if args.best_effort:
        command += ["-p", "publish_qos:=sensor_data"]
    for parameter in args.parameter:
        command += ["-p", parameter]
    node = subprocess.Popen(command)
    processes = [
        context.Process(target=receive, args=(args.depth, not args.best_effort, ready, stop, results)),
        context.Process(target=publish, args=(args.seconds, ready)),
    ]
    for process in processes:
        process.start()
    processes[1].join()
    stop.set()
    latencies, last = results.get(timeout=30)
    processes[0].join()
    node.terminate()
    node.wait(10)
    latencies.sort()
    at = lambda q: round(1000 * latencies[min(len(latencies) - 1, int(q * len(latencies)))], 1) if latencies else None
    sent = HZ * args.seconds
    print(json.dumps({
        "sent": sent, "received": len(latencies), "per_second": round(len(latencies) / args.seconds, 2),
        "p50_ms": at(0.5), "p95_ms": at(0.95), "p99_ms": at(0.99), "max_ms": at(1), "last": last,
        "profile": os.environ.get("FASTRTPS_DEFAULT_PROFILES_FILE") or os.environ.get("FASTDDS_DEFAULT_PROFILES_FILE"),
    }))


if __name__ == "__main__":
    sys.exit(main())
