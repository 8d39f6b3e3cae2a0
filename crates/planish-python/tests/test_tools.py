"""Conversion, comparison, merging, meshes, cleaning and pictures."""

import json
import struct

import numpy as np
import pytest

import planish

FRAME = planish.simulate("table")


@pytest.fixture
def depth(tmp_path):
    planish.write(tmp_path / "depth.png", FRAME.depth)
    return tmp_path / "depth.png"


def test_depth_becomes_a_cloud_and_comes_back(depth, tmp_path):
    planish.convert(depth, tmp_path / "cloud.pcd", camera=FRAME.camera)
    assert planish.read(tmp_path / "cloud.pcd").points.shape == (480, 640, 3)
    planish.convert(tmp_path / "cloud.pcd", tmp_path / "back.png")
    assert np.array_equal(planish.read(tmp_path / "back.png").depth, FRAME.depth)
    with pytest.raises(ValueError, match="needs its camera"):
        planish.convert(depth, tmp_path / "cloud.ply")
    with pytest.warns(RuntimeWarning, match="holes are dropped"):
        planish.convert(tmp_path / "cloud.pcd", tmp_path / "dense.ply", drop_holes=True)
    assert planish.read(tmp_path / "dense.ply").points.shape == ((FRAME.depth > 0).sum(), 3)


def test_coordinates_have_four_bytes_where_they_suffice(tmp_path):
    points = np.random.default_rng(1).random((50, 3))
    fields = {"intensity": np.arange(50, dtype=np.float32), "label": np.arange(50, dtype=np.uint8)}
    planish.write(tmp_path / "near.npz", points, fields=fields)
    planish.convert(tmp_path / "near.npz", tmp_path / "near.pcd", fields=["label"])
    header = (tmp_path / "near.pcd").read_bytes()[:200]
    assert b"SIZE 4 4 4 1" in header and b"intensity" not in header
    planish.write(tmp_path / "far.laz", points + 500_000.0)
    with pytest.warns(RuntimeWarning, match="PCL"):
        planish.convert(tmp_path / "far.laz", tmp_path / "far.pcd")
    assert b"SIZE 8 8 8" in (tmp_path / "far.pcd").read_bytes()[:300]
    planish.convert(tmp_path / "far.laz", tmp_path / "rounded.pcd", encoding="ascii,f32")
    assert b"SIZE 4 4 4" in (tmp_path / "rounded.pcd").read_bytes()[:300]
    with pytest.raises(ValueError, match="no field .colour.; its fields are intensity label"):
        planish.convert(tmp_path / "near.npz", tmp_path / "x.ply", fields=["colour"])


def test_files_are_compared(depth, tmp_path):
    smoothed = planish.smooth(FRAME.depth, FRAME.camera, outputs=["depth"]).depth
    planish.write(tmp_path / "smoothed.png", smoothed)
    found = planish.compare(depth, tmp_path / "smoothed.png")
    both = (FRAME.depth > 0) & (smoothed > 0)
    difference = np.abs(FRAME.depth[both].astype(float) - smoothed[both])
    assert (found.matching, found.unit) == ("index", "raw") and found.distances.count == both.sum()
    assert found.distances.rms == pytest.approx(np.sqrt((difference**2).mean()))
    assert found.distances.max == difference.max() and found.only_in == ((FRAME.depth > 0).sum() - both.sum(), 0)
    assert planish.compare(depth, depth, camera=FRAME.camera).distances.max == 0.0


def test_clouds_are_merged_with_their_poses(tmp_path):
    points = np.zeros((2, 3), np.float32)
    for name in ("a.pcd", "b.pcd"):
        planish.write(tmp_path / name, points)
    moved = [(0, 0, 0, 1, 0, 0, 0), (1, 2, 3, 1, 0, 0, 0)]
    assert planish.merge([tmp_path / "a.pcd", tmp_path / "b.pcd"], tmp_path / "all.ply", poses=moved) == 4
    merged = planish.read(tmp_path / "all.ply")
    assert merged.points.tolist() == [[0, 0, 0], [0, 0, 0], [1, 2, 3], [1, 2, 3]]
    assert merged.fields["scan"].tolist() == [0, 0, 1, 1]
    with pytest.raises(ValueError, match="one per input"):
        planish.merge([tmp_path / "a.pcd"], tmp_path / "x.ply", poses=moved)


def test_meshes_have_triangles_within_surfaces_only(depth, tmp_path):
    vertices, triangles = planish.mesh(depth, tmp_path / "mesh.ply", camera=FRAME.camera)
    text, _, data = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header\n")
    assert f"element vertex {vertices}\n".encode() in text and f"element face {triangles}\n".encode() in text
    points = np.frombuffer(data, "<f4", 6 * vertices).reshape(-1, 6)[:, :3]
    faces = np.frombuffer(data[24 * vertices :], np.dtype([("count", "u1"), ("index", "<i4", 3)]))
    assert len(faces) == triangles > 400_000 and (faces["count"] == 3).all()
    depths = points[faces["index"], 2]
    spread = depths.max(axis=1) - depths.min(axis=1)
    # Triangles across the scene's steps of 20 cm and more would have a large spread.
    assert (spread > 0.1).mean() < 1e-3
    assert planish.mesh(depth, tmp_path / "mesh.glb", camera=FRAME.camera) == (vertices, triangles)
    magic, version, length, size, kind = struct.unpack("<4sIII4s", (tmp_path / "mesh.glb").read_bytes()[:20])
    assert (magic, version, kind) == (b"glTF", 2, b"JSON") and length == (tmp_path / "mesh.glb").stat().st_size
    described = json.loads((tmp_path / "mesh.glb").read_bytes()[20 : 20 + size])
    assert described["accessors"][0]["count"] == vertices
    assert planish.mesh(depth, tmp_path / "mesh.stl", camera=FRAME.camera)[1] == triangles
    assert (tmp_path / "mesh.stl").stat().st_size == 84 + 50 * triangles
    with pytest.raises(ValueError, match="expected .ply"):
        planish.mesh(depth, tmp_path / "mesh.xyz", camera=FRAME.camera)


def test_clouds_are_cleaned_and_drawn():
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.random((3000, 3)) * [1, 1, 0.001], [[0.5, 0.5, 5.0]]])
    frame = planish.Frame("", points=points, fields={"label": np.arange(len(points), dtype=np.uint16)})
    cleaned = planish.clean(frame, statistical=(10, 3.0))
    assert len(cleaned.points) > 2900 and cleaned.points[:, 2].max() < 0.01
    assert len(cleaned.fields["label"]) == len(cleaned.points) and 3000 not in cleaned.fields["label"]
    organized = np.full((2, 2, 3), 1.0, np.float32)
    cropped = planish.clean(organized, crop=([0, 0, 0], [0.5, 1, 1])).points
    assert cropped.shape == (2, 2, 3) and np.isnan(cropped).all()
    with pytest.raises(ValueError, match="no step"):
        planish.clean(points)
    with pytest.raises(ValueError, match="voxel"):
        planish.clean(points, voxel=-1.0)
    picture = planish.render(FRAME.points)
    assert picture.shape == (480, 640, 3) and picture.dtype == np.uint8 and picture.std() > 5
    assert planish.render(points, direction=(0, 0, 1)).ndim == 3


def test_frames_are_prepared():
    cleaned, camera = planish.prepare(FRAME.depth, FRAME.camera, remove_floating=True)
    assert 0 < (cleaned != FRAME.depth).sum() < 5000 and (cleaned[cleaned != FRAME.depth] == 0).all()
    near, _ = planish.prepare(FRAME.depth, FRAME.camera, min_range_m=0.7, max_range_m=1.0)
    assert np.array_equal(near, np.where((FRAME.depth >= 700) & (FRAME.depth <= 1000), FRAME.depth, 0))
    half, camera = planish.prepare(FRAME.depth, FRAME.camera, decimate=2)
    assert half.shape == (240, 320) and (camera.fx, camera.cx) == (262.5, 159.5)
    # On flat parts, the mean of four pixels has less noise than one pixel, but more than half of it, because the
    # noise of neighbours is correlated.
    truth = FRAME.points[..., 2].reshape(240, 2, 320, 2).transpose(0, 2, 1, 3).reshape(240, 320, 4)
    flat = (np.ptp(truth, axis=2) < 0.01) & (half > 0)
    raw = np.abs(FRAME.depth[::2, ::2] / 1000.0 - truth[..., 0])[flat]
    assert np.sqrt(((half / 1000.0 - truth.mean(axis=2))[flat] ** 2).mean()) < 0.95 * np.sqrt((raw**2).mean())
    with pytest.raises(ValueError, match="decimate"):
        planish.prepare(FRAME.depth, FRAME.camera, decimate=9)
    with pytest.raises(ValueError, match="planish.prepare"):
        planish.Smoother(FRAME.camera, decimate=2)
    with pytest.raises(TypeError, match="uint16"):
        planish.prepare(FRAME.points, FRAME.camera)
    (frame,) = planish.stream("synthetic", frames=1, outputs=["points"], decimate=4)
    assert frame.smoothed.points.shape == (120, 160, 3)


def test_results_are_described_in_a_line():
    result = planish.smooth(FRAME.depth, FRAME.camera)
    assert repr(result) == "Smoothed(points=float32[480, 640, 3], normals=float32[480, 640, 3], status=uint8[480, 640])"
    assert repr(FRAME).startswith("Simulated(depth=uint16[480, 640], camera=Camera(") and "\n" not in repr(FRAME)
    frame = planish.Frame("PCD", points=np.zeros((2, 3)), fields={"label": np.zeros(2, np.uint8)})
    assert repr(frame) == "Frame(format='PCD', points=float64[2, 3], fields={label: uint8[2]})"


def test_an_unusable_source_raises(tmp_path):
    (tmp_path / "frame.pcd").write_text("nothing of the kind")
    with pytest.raises(ValueError, match="frame.pcd"):
        list(planish.stream(tmp_path))


def test_depth_in_float64_is_accepted():
    metres = np.where(FRAME.depth > 0, FRAME.depth / 1000.0, np.nan)
    double = planish.smooth(metres, FRAME.camera, engine="cpu").points
    single = planish.smooth(metres.astype(np.float32), FRAME.camera, engine="cpu").points
    assert np.array_equal(double, single, equal_nan=True)
    assert np.array_equal(planish.smooth(metres[:, :, None], FRAME.camera, engine="cpu").points, single, equal_nan=True)
