"""Smooths recordings written by rosbags, and reads the results with another library, mcap-ros2-support."""

import json
import signal
import struct
import subprocess
import time
import zlib

import numpy as np
import pytest
from conftest import CAMERA, FOCAL, HEIGHT, PROJECTION, WIDTH, depth_mm, program, roughness, smooth
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
FRAMES = 3
IMAGE, COMPRESSED = "/camera/depth/image_rect_raw", "/camera/depth/image_rect_raw/compressedDepth"
FLOAT, CLOUD, INFO = "/camera/float/image_rect", "/lidar/points", "/camera/depth/camera_info"


def message(name, *values):
    return TYPES[f"{name.split('/')[0]}/msg/{name.split('/')[1]}"](*values)


def png(depth):
    """Encodes depth as a 16-bit greyscale PNG."""
    height, width = depth.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in depth)
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def cloud_of(header, depth):
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    z = np.where(depth > 0, depth / 1000, np.nan).astype(np.float32)
    points = np.zeros((height, width, 8), np.float32)
    points[..., 0], points[..., 1], points[..., 2] = (u - CAMERA[2]) * z / FOCAL, (v - CAMERA[5]) * z / FOCAL, z
    points[..., 4] = np.arange(width * height, dtype=np.uint32).reshape(height, width).view(np.float32)
    fields = [message("sensor_msgs/PointField", name, offset, 7, 1) for name, offset in
              [("x", 0), ("y", 4), ("z", 8), ("rgb", 16)]]
    data = points.view(np.uint8).ravel()
    return message("sensor_msgs/PointCloud2", header, height, width, fields, False, 32, 32 * width, data, False)


def camera_info(header):
    roi = message("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
    return message("sensor_msgs/CameraInfo", header, HEIGHT, WIDTH, "plumb_bob", np.zeros(5), np.array(CAMERA),
                   np.eye(3).ravel(), np.array(PROJECTION), 0, 0, roi)


@pytest.fixture
def bag(tmp_path):
    """Writes a recording with every kind of depth topic, and with topics that have no depth."""
    folder = tmp_path / "bag"
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        kinds = {IMAGE: "Image", COMPRESSED: "CompressedImage", FLOAT: "Image", CLOUD: "PointCloud2", INFO: "CameraInfo",
                 "/camera/float/camera_info": "CameraInfo"}
        connections = {t: writer.add_connection(t, f"sensor_msgs/msg/{kind}", typestore=STORE) for t, kind in kinds.items()}
        chatter = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)

        def write(topic, time, sent):
            connection = connections[topic]
            writer.write(connection, time, STORE.serialize_cdr(sent, connection.msgtype))

        for i in range(FRAMES):
            time = 1_700_000_000_123_456_789 + i * 33_333_333
            header = message("std_msgs/Header", message("builtin_interfaces/Time", time // 10**9, time % 10**9), f"lens{i}")
            depth = depth_mm(i)
            metres = np.where(depth > 0, depth / 1000, np.nan).astype(np.float32)
            image = lambda kind, step, data: message(
                "sensor_msgs/Image", header, HEIGHT, WIDTH, kind, 0, step, np.ascontiguousarray(data).view(np.uint8).ravel())
            for topic in (INFO, "/camera/float/camera_info"):
                write(topic, time, camera_info(header))
            write(IMAGE, time, image("16UC1", 2 * WIDTH, depth))
            write(FLOAT, time, image("32FC1", 4 * WIDTH, metres))
            packed = np.frombuffer(b"\0" * 12 + png(depth), np.uint8)
            write(COMPRESSED, time, message("sensor_msgs/CompressedImage", header, "16UC1; compressedDepth png", packed))
            write(CLOUD, time, cloud_of(header, depth))
            text = STORE.serialize_cdr(message("std_msgs/String", f"hello {i}"), "std_msgs/msg/String")
            writer.write(chatter, time + 1, text)
    return next(folder.glob("*.mcap"))


def raw_messages(path):
    with open(path, "rb") as file:
        return [(c.topic, s and s.name, m.log_time, m.publish_time, m.sequence, m.data)
                for s, c, m in make_reader(file).iter_messages(log_time_order=False)]


def decoded(path, topic):
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [sent for _, _, _, sent in reader.iter_decoded_messages(topics=[topic])]


def test_only_the_topic_s_data_change(bag, tmp_path):
    out = tmp_path / "out.mcap"
    smooth(bag, out, "--topic", IMAGE)
    before, after = raw_messages(bag), raw_messages(out)
    assert len(before) == 7 * FRAMES and [m[:5] for m in before] == [m[:5] for m in after]
    for was, now in zip(before, after):
        assert (was[5] == now[5]) == (was[0] != IMAGE), was[0]
    for was, now in zip(decoded(bag, IMAGE), decoded(out, IMAGE)):
        assert (was.header.frame_id, was.header.stamp.nanosec) == (now.header.frame_id, now.header.stamp.nanosec)
        pixels = [np.frombuffer(bytes(image.data), np.uint16).reshape(HEIGHT, WIDTH) for image in (was, now)]
        assert roughness(pixels[1]) < 0.4 * roughness(pixels[0])
        assert (pixels[1][:, :4] == 0).all() and np.abs(pixels[1].astype(int) - pixels[0])[:, 8:].max() < 60


def test_all_kinds_are_smoothed_alike(bag, tmp_path):
    out = tmp_path / "out.mcap"
    topics = [argument for topic in (IMAGE, FLOAT, COMPRESSED, CLOUD) for argument in ("--topic", topic)]
    report = json.loads(smooth(bag, out, *topics, "--json"))
    assert [t["smoothed"] for t in report["topics"]] == [FRAMES] * 4 and report["copied"] == 3 * FRAMES
    image = np.frombuffer(bytes(decoded(out, IMAGE)[1].data), np.uint16).reshape(HEIGHT, WIDTH)
    metres = np.frombuffer(bytes(decoded(out, FLOAT)[1].data), np.float32).reshape(HEIGHT, WIDTH)
    valid = image > 0
    assert valid.sum() > 0.9 * valid.size and np.abs(1000 * metres - image)[valid].max() <= 0.51
    compressed = bytes(decoded(out, COMPRESSED)[1].data)
    assert compressed[:12] == b"\0" * 12 and compressed[12:16] == b"\x89PNG"
    cloud = decoded(out, CLOUD)[1]
    points = np.frombuffer(bytes(cloud.data), np.float32).reshape(HEIGHT, WIDTH, 8)
    # Clouds are smoothed along the rays, like depth.
    assert np.nanmax(np.abs(points[..., 2] - metres)) < 1e-5
    was = np.frombuffer(bytes(decoded(bag, CLOUD)[1].data), np.uint8).reshape(HEIGHT, WIDTH, 32)
    assert (points.view(np.uint8)[..., 12:] == was[..., 12:]).all()
    assert not cloud.is_dense and cloud.point_step == 32


def test_the_result_is_that_of_the_command_on_the_image(bag, tmp_path):
    folder = tmp_path / "frames"
    (tmp_path / "frame.png").write_bytes(png(depth_mm(1)))
    camera = f"{FOCAL},{FOCAL},{CAMERA[2]},{CAMERA[5]}"
    smooth(bag, folder, "--topic", IMAGE)
    smooth(tmp_path / "frame.png", tmp_path / "smooth.png", "--camera", camera)
    assert (folder / "000001.png").read_bytes() == (tmp_path / "smooth.png").read_bytes()
    assert json.loads((folder / "camera.json").read_text())["fx"] == FOCAL
    # The frames become a recording again, whose image another library reads.
    back = tmp_path / "back.mcap"
    smooth(folder, back, "--strength", "0")
    image = decoded(back, "/camera/depth/image_rect")[2]
    assert (image.encoding, image.width, image.step) == ("16UC1", WIDTH, 2 * WIDTH)
    assert decoded(back, INFO)[0].k[0] == FOCAL


def test_clouds_of_depth_are_added_on_a_topic_of_their_own(bag, tmp_path):
    out = tmp_path / "out.mcap"
    smooth(bag, out, "--topic", IMAGE, "--points-topic", "/smooth/points", "--fields", "normals,curvature")
    clouds = decoded(out, "/smooth/points")
    assert len(clouds) == FRAMES and clouds[0].point_step == 32
    points = np.frombuffer(bytes(clouds[2].data), np.float32).reshape(HEIGHT, WIDTH, 8)
    names = [field.name for field in clouds[0].fields]
    assert names == ["x", "y", "z", "normal_x", "normal_y", "normal_z", "curvature"]
    lengths = np.linalg.norm(points[..., 4:7], axis=2)
    assert np.nanmax(np.abs(lengths - 1)) < 1e-4


def test_what_is_wrong_is_said(bag, tmp_path):
    out = tmp_path / "out.mcap"
    assert "choose one (topic)" in smooth(bag, out, code=2)
    assert "/nowhere" in smooth(bag, out, "--topic", "/nowhere", code=2)
    assert "--overwrite" in smooth(bag, bag, "--topic", IMAGE, code=2)
    assert "already has a topic /chatter" in smooth(bag, out, "--topic", IMAGE, "--points-topic", "/chatter", code=2)
    folder = tmp_path / "sqlite"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    for name, kind in [("a.bag", "ROS 1"), ("a.db3", "SQLite"), ("sqlite/a.db3", "SQLite"), ("sqlite", "SQLite")]:
        if name != "sqlite":
            (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
        text = smooth(tmp_path / name, out, code=2)
        assert kind in text and "rosbags-convert" in text
    (tmp_path / "a.mcap.zstd").write_bytes(bag.read_bytes())
    assert "zstd -d" in smooth(tmp_path / "a.mcap.zstd", out, code=2)
    assert not out.exists()


def test_a_folder_of_rosbag2_is_its_recording(bag, tmp_path):
    smooth(bag.parent, tmp_path / "out.mcap", "--topic", IMAGE)
    assert len(decoded(tmp_path / "out.mcap", IMAGE)) == FRAMES


def copy(source, path, leave_out=(), **options):
    """Copies the messages to a recording that is written with other options."""
    with open(source, "rb") as old, open(path, "wb") as new:
        writer, channels = McapWriter(new, **options), {}
        writer.start("ros2")
        for schema, channel, sent in make_reader(old).iter_messages(log_time_order=False):
            if channel.topic in leave_out:
                continue
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.id], sent.log_time, sent.data, sent.publish_time, sent.sequence)
        writer.finish()


def test_a_summary_need_not_repeat_channels_and_schemas(bag, tmp_path):
    smooth(bag, tmp_path / "whole.mcap", "--topic", IMAGE)
    for parts in ({"repeat_channels": False}, {"repeat_schemas": False}):
        copy(bag, tmp_path / "in.mcap", **parts)
        smooth(tmp_path / "in.mcap", tmp_path / "out.mcap", "--topic", IMAGE, "--overwrite")
        assert raw_messages(tmp_path / "out.mcap") == raw_messages(tmp_path / "whole.mcap")
        taken = smooth(tmp_path / "in.mcap", tmp_path / "no.mcap", "--topic", IMAGE, "--points-topic", "/chatter", code=2)
        assert "already has a topic /chatter" in taken


def test_topics_with_depth_that_are_not_smoothed_are_named(bag, tmp_path):
    copy(bag, tmp_path / "in.mcap", leave_out=[FLOAT])
    text = smooth(tmp_path / "in.mcap", tmp_path / "out.mcap", "--fields", "normals")
    assert f"depth on {COMPRESSED}, {CLOUD} was copied" in text.replace(f"{CLOUD}, {COMPRESSED}", f"{COMPRESSED}, {CLOUD}")
    assert "add clouds with --points-topic" in text
    assert "was copied" not in smooth(bag, tmp_path / "two.mcap", "--topic", IMAGE, "--topic", CLOUD)


def test_a_chunk_with_a_wrong_checksum_is_said_and_the_next_ones_are_smoothed(bag, tmp_path):
    damaged, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    copy(bag, damaged, leave_out=[FLOAT, CLOUD, COMPRESSED], chunk_size=100, compression=CompressionType.NONE)
    data, pixels = bytearray(damaged.read_bytes()), decoded(damaged, IMAGE)[0].data
    data[data.index(bytes(pixels[-1000:])) + 500] ^= 1
    damaged.write_bytes(data)
    text = smooth(damaged, out, code=1)
    assert "wrong checksum in 1 chunk" in text and f"{FRAMES} messages smoothed" in text
    assert len(raw_messages(out)) == 4 * FRAMES
    run = subprocess.run([program("planish"), "stream", "--json", damaged], capture_output=True, text=True)
    assert run.returncode == 1 and json.loads(run.stdout)["frames_out"] == FRAMES and "checksum" in run.stderr


def test_info_lists_all_topics(bag):
    run = subprocess.run([program("planish"), "info", "--json", bag], capture_output=True, text=True, check=True)
    others = json.loads(run.stdout)["other_topics"]
    assert others == [{"topic": "/chatter", "type": "std_msgs/msg/String", "messages": FRAMES}]


def test_options_that_recordings_cannot_have_are_refused(bag, tmp_path):
    out = tmp_path / "out.mcap"
    for output, *options in [(tmp_path / "out.pcd",), (out, "--format", "pcd"), (tmp_path / "f", "--format", "tiff"),
                             (out, "--depth-units-per-metre", "5000"), (out, "--points-topic", "bad topic"), (out, "--repeat", "2")]:
        text = smooth(bag, output, "--topic", IMAGE, *options, code=2)
        assert options[:1] == [] or options[0].strip("-").replace("-", "_") in text.replace("-", "_"), text
        assert not output.exists()


def test_a_radius_that_loses_the_points_is_warned_of(bag, tmp_path):
    assert "became holes" in smooth(bag, tmp_path / "out.mcap", "--topic", IMAGE, "--radius", "0.0001")


def test_metres_are_written_as_images_where_images_are_asked_for(bag, tmp_path):
    smooth(bag, tmp_path / "png", "--topic", FLOAT, "--format", "png")
    assert len(list((tmp_path / "png").glob("*.png"))) == FRAMES
    smooth(bag, tmp_path / "clouds", "--topic", FLOAT)
    assert len(list((tmp_path / "clouds").glob("*.pcd"))) == FRAMES


def test_a_signal_leaves_no_part_of_a_recording(bag, tmp_path):
    frames, out = tmp_path / "frames", tmp_path / "out.mcap"
    frames.mkdir()
    for i in range(300):
        (frames / f"{i:03}.png").write_bytes(png(depth_mm(i % 3, 640, 480)))
    command = [program("planish"), "smooth", frames, out, "--camera", "525,525,319.5,239.5", "--engine", "cpu"]
    # A process that a shell starts in the background would ignore SIGINT.
    heeds = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heeds)
    time.sleep(0.7)
    run.send_signal(signal.SIGINT)
    assert run.wait(20) == 130, run.stderr.read()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "frames"]


def test_a_recording_that_was_cut_off_is_smoothed_up_to_there(bag, tmp_path):
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    data = bag.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    text = smooth(cut, out, "--topic", IMAGE, code=1)
    assert "everything before that was written" in text
    with open(out, "rb") as file:
        # Complete, with a summary.
        assert make_reader(file).get_summary().statistics.message_count > 0
    # Chunks stay uncompressed although the summary that states their compression was cut off.
    copy(bag, tmp_path / "plain.mcap", chunk_size=100_000, compression=CompressionType.NONE)
    plain = (tmp_path / "plain.mcap").read_bytes()
    cut.write_bytes(plain[: len(plain) * 2 // 3])
    smooth(cut, out, "--topic", IMAGE, "--overwrite", code=1)
    with open(out, "rb") as file:
        assert {chunk.compression for chunk in make_reader(file).get_summary().chunk_indexes} == {""}
    for length in (0, 7, 20, 60):
        cut.write_bytes(data[:length])
        smooth(cut, tmp_path / "none.mcap", "--topic", IMAGE, code=2)
    assert not (tmp_path / "none.mcap").exists()


def test_attachments_metadata_and_channels_come_through(tmp_path):
    source, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    header = message("std_msgs/Header", message("builtin_interfaces/Time", 5, 6), "lens")
    cdr = lambda sent, kind: bytes(STORE.serialize_cdr(sent, kind))
    with open(source, "wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2", library="test")
        schema = lambda kind: writer.register_schema(f"sensor_msgs/msg/{kind}", "ros2msg", b"kept as it is")
        qos = {"offered_qos_profiles": "- history: 1", "mine": "yes"}
        image = writer.register_channel("/depth/image", "cdr", schema("Image"), metadata=qos)
        info = writer.register_channel("/depth/camera_info", "cdr", schema("CameraInfo"))
        other = writer.register_channel("/json", "json", 0)
        data = np.ascontiguousarray(depth_mm(3)).view(np.uint8).ravel()
        sent = message("sensor_msgs/Image", header, HEIGHT, WIDTH, "16UC1", 0, 2 * WIDTH, data)
        # One image precedes its camera, and another one is damaged.
        writer.add_message(image, 10, cdr(sent, "sensor_msgs/msg/Image"), 11, 42)
        writer.add_message(info, 12, cdr(camera_info(header), "sensor_msgs/msg/CameraInfo"), 13)
        writer.add_message(other, 14, b'{"a": 1}', 15)
        writer.add_message(image, 16, cdr(sent, "sensor_msgs/msg/Image")[:100], 17, 43)
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"as it was")
        writer.add_metadata("place", {"room": "7"})
        writer.finish()
    text = smooth(source, out, code=1)
    assert "1 message copied unchanged because of errors" in text
    before, after = raw_messages(source), raw_messages(out)
    assert [m[:5] for m in before] == [m[:5] for m in after] and before[3] == after[3] and before[0][5] != after[0][5]
    with open(out, "rb") as file:
        reader = make_reader(file)
        attachment, metadata = next(reader.iter_attachments()), next(reader.iter_metadata())
        channels = {channel.topic: channel for channel in reader.get_summary().channels.values()}
    assert (attachment.name, attachment.data, metadata.metadata) == ("notes.txt", b"as it was", {"room": "7"})
    assert channels["/depth/image"].metadata == qos and channels["/json"].message_encoding == "json"
