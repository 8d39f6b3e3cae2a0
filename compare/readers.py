"""Compares planish's readers with other readers, on folders of files. Called by readers.sh.

A file agrees if planish and every other reader that can read it find the same number of points, the same coordinates,
and the same values in every field with the same name. Files that planish rejects, and files that only planish reads,
are listed with the reason.
"""

import json
import multiprocessing
import pickle
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pye57
import pypcd4
import tifffile
import trimesh

TOLERANCE = 1e-6
"""Tolerance relative to the largest coordinate, for formats that store text or floats; scales of LAS are finer."""

SECONDS = 30
"""Time limit of another reader in seconds."""

MEMORY = 4 << 30
"""Memory limit of another reader in bytes."""


def of_las(path):
    with laspy.open(path) as file:
        cloud = file.read()
    fields = {name: np.asarray(cloud[name]) for name in cloud.point_format.dimension_names if name not in "XYZ"}
    return np.stack([cloud.x, cloud.y, cloud.z], -1), fields


def of_ply(path):
    vertex = plyfile.PlyData.read(path)["vertex"].data
    lower = {name.lower(): name for name in vertex.dtype.names}
    points = np.stack([np.asarray(vertex[lower[axis]], float) for axis in "xyz"], -1)
    return points, {name: vertex[name] for name in vertex.dtype.names if name.lower() not in "xyz"}


def of_pcd(path):
    data = pypcd4.PointCloud.from_path(path).pc_data.reshape(-1)
    lower = {name.lower(): name for name in data.dtype.names}
    points = np.stack([np.asarray(data[lower[axis]], float) for axis in "xyz"], -1)
    return points, {name: data[name] for name in data.dtype.names if name.lower() not in "xyz"}


def of_e57(path):
    file, points, colours = pye57.E57(str(path)), [], []
    for scan in range(file.scan_count):
        found = file.read_scan(scan, ignore_missing_fields=True, colors=True, intensity=False, transform=True)
        points.append(np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], -1))
        if "colorRed" in found:
            colours.append(found["colorRed"])
    fields = {"red": np.concatenate(colours)} if len(colours) == file.scan_count and colours else {}
    return np.concatenate(points), fields


def of_mesh(path):
    mesh = trimesh.load(path, process=False, force="mesh", skip_materials=True)
    return np.asarray(mesh.vertices), {}


def of_obj(path):
    # Read the vertices directly, because mesh readers create one vertex for every corner of a texture.
    lines = Path(path).read_text(errors="replace").splitlines()
    vertices = [line.split()[1:4] for line in lines if line.split()[:1] == ["v"]]
    return np.array(vertices, float).reshape(-1, 3), {}


def of_text(path):
    first = Path(path).read_text(encoding="utf-8-sig", errors="replace").split("\n", 1)[0]
    names = [name.strip().strip('"').lower() for name in first.split(",")]
    if {"x", "y", "z"} <= set(names):
        return np.loadtxt(path, delimiter=",", skiprows=1, usecols=[names.index(axis) for axis in "xyz"], ndmin=2), {}
    rows = []
    for line in Path(path).read_text(encoding="utf-8-sig", errors="replace").splitlines():
        try:
            rows.append([float(word) for word in line.replace(",", " ").replace(";", " ").split()])
        except ValueError:
            continue
    width = Counter(len(row) for row in rows).most_common(1)[0][0]
    return np.array([row[:3] for row in rows if len(row) == width]), {}


def of_numpy(path):
    array = np.load(path)
    if not isinstance(array, np.lib.npyio.NpzFile) and array.ndim == 3 and array.shape[2] > 16:
        return array[0], None
    if isinstance(array, np.lib.npyio.NpzFile):
        array = next(array[name] for name in ("points", "xyz", "positions", *array.files) if name in array.files)
    if array.ndim == 2 and array.shape[1] != 3 and array.dtype.kind in "iu":
        return array, None
    return np.asarray(array, float)[..., :3].reshape(-1, 3), {}


def of_tiff(path):
    return tifffile.imread(path, key=0), None


def of_open3d(path):
    import open3d  # noqa: PLC0415, takes seconds, and most formats do not need it

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    points = np.asarray(cloud.points)
    if not len(points):
        # Open3D reports no errors.
        raise ValueError("no points")
    colours = np.round(255 * np.asarray(cloud.colors))
    return points, dict(zip(("red", "green", "blue"), colours.T, strict=True)) if len(colours) else {}


READERS = {
    ".las": [of_las], ".laz": [of_las], ".ply": [of_ply, of_open3d], ".pcd": [of_pcd, of_open3d], ".e57": [of_e57], ".obj": [of_obj],
    ".off": [of_mesh], ".stl": [of_mesh], ".txt": [of_text], ".xyz": [of_text, of_open3d], ".xyzn": [of_text, of_open3d],
    ".asc": [of_text], ".pts": [of_text, of_open3d], ".csv": [of_text], ".npy": [of_numpy], ".npz": [of_numpy], ".tif": [of_tiff],
    ".tiff": [of_tiff],
}  # fmt: skip


def by_another(reader, path, folder):
    """Return points and fields read by another reader, or the reason for its failure."""
    out = Path(folder, "other.pickle")
    out.unlink(missing_ok=True)

    def read():
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        try:
            found = reader(path), ""
        except BaseException as error:  # noqa: BLE001, other readers even panic
            found = None, f"{type(error).__name__}: {error}".replace("\n", " ")[:100]
        out.write_bytes(pickle.dumps(found))

    # Some readers never finish, or use all memory.
    process = multiprocessing.get_context("fork").Process(target=read)
    process.start()
    process.join(SECONDS)
    if process.is_alive():
        process.kill()
        process.join()
        return None, f"took over {SECONDS} s"
    return pickle.loads(out.read_bytes()) if out.exists() else (None, "crashed")


def by_planish(planish, path, folder):
    """Return points and fields read by planish, or the reason for its failure."""
    info = subprocess.run([planish, "info", "--json", path], capture_output=True, text=True, timeout=120)
    if info.returncode != 0:
        return None, info.stderr.strip().splitlines()[-1].split(": ", 2)[-1] if info.stderr.strip() else f"exit {info.returncode}"
    described = json.loads(info.stdout)
    if described["fields"] == ["depth"]:
        out = Path(folder, "out.npy")
        run = subprocess.run([planish, "convert", path, out, "--overwrite"], capture_output=True, text=True, timeout=120)
        return (np.load(out), None) if run.returncode == 0 else (None, run.stderr)
    out = Path(folder, "out.npz")
    run = subprocess.run([planish, "convert", path, out, "--overwrite"], capture_output=True, text=True, timeout=300)
    if run.returncode != 0:
        return None, f"convert: {run.stderr.strip()}"
    arrays = dict(np.load(out))
    points = arrays.pop("points")
    fields = {name: array.reshape(-1, *array.shape[points.ndim - 1 :]) for name, array in arrays.items()}
    if "rgb" in fields:
        fields |= {name: fields["rgb"][..., k] for k, name in enumerate(("red", "green", "blue"))}
    return points.reshape(-1, 3), fields


def difference(own, other, suffix):
    """Return a description of the difference, or an empty string."""
    (points, fields), (expected, other_fields) = own, other
    if fields is None or other_fields is None:
        same = points.shape == expected.shape and np.array_equal(points, expected.astype(points.dtype))
        return "" if same else "depth differs"
    finite = np.isfinite(points).all(-1)
    if suffix == ".stl":
        points, expected = np.unique(points[finite], axis=0), np.unique(expected.astype(np.float32).astype(float), axis=0)
    elif len(points) != len(expected):
        expected_finite = np.isfinite(expected).all(-1)
        if finite.sum() != expected_finite.sum():
            return f"{len(points)} points, {len(expected)} by the other"
        points, expected, other_fields = points[finite], expected[expected_finite], {}
    if len(points) != len(expected):
        return f"{len(points)} points, {len(expected)} by the other"
    if not len(points):
        return ""
    both = np.isfinite(points).all(-1) & np.isfinite(expected).all(-1)
    scale = np.abs(expected[both]).max(initial=1e-3)
    worst = np.abs(points[both] - expected[both]).max(initial=0)
    if worst > TOLERANCE * scale:
        return f"coordinates differ by {worst:g}"
    for name, values in (other_fields or {}).items():
        found = fields.get(name)
        if found is None or values.dtype.kind not in "iuf" or found.dtype.kind not in "iuf" or found.shape != values.shape:
            continue
        if not np.allclose(found.astype(float), values.astype(float), rtol=1e-5, atol=1e-6, equal_nan=True):
            return f"the field {name} differs"
    return ""


def main():
    planish, folders = sys.argv[1], [Path(folder) for folder in sys.argv[2:]]
    counts, lines = Counter(), []
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.is_file()):
        suffix = path.suffix.lower()
        with tempfile.TemporaryDirectory() as folder:
            try:
                *own, problem = by_planish(planish, str(path), folder)
            except subprocess.TimeoutExpired:
                own, problem = [None], "took over two minutes"
            own = (own[0], problem) if own[0] is not None else None
            others = {reader: by_another(reader, path, folder) for reader in READERS.get(suffix, [])}
        read = {reader: found for reader, (found, _) in others.items() if found is not None}
        if own is None:
            kind = "refused by planish alone" if read else "refused by all" if others else "refused"
            lines.append((kind, path, problem))
        elif not read:
            kind = "read by planish alone"
            lines.append((kind, path, "; ".join(reason for _, reason in others.values()) or "no second reader"))
        else:
            found = {reader: difference(own, other, suffix) for reader, other in read.items()}
            found = [f"{text} ({reader.__name__})" for reader, text in found.items() if text]
            kind = "differs" if found else "agrees with two" if len(read) == 2 else "agrees"
            if found:
                lines.append((kind, path, "; ".join(found)))
        counts[kind] += 1
    for kind, path, text in sorted(lines, key=lambda line: line[0]):
        print(f"{kind}: {path}: {text}")
    print(f"{sum(counts.values())} files: " + ", ".join(f"{count} {kind}" for kind, count in counts.most_common()))


main()
