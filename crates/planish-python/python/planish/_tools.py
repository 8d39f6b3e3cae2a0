"""Tools for files and clouds: conversion, comparison, merging, meshes, cleaning, rendering and preparation."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import _planish
from ._arrays import as_array
from ._files import Encoding, Frame, _cloud, _frame, _native
from ._planish import Camera

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._settings import Settings

Path = str | PathLike[str]


@dataclass(slots=True)
class Distances:
    """Statistics of distances in metres or in raw depth units; NaN without distances.

    Attributes
    ----------
    count, equal : int
        Number of matched points, and number of matched points that are equal.
    mean, rms, median, p95, max : float
        Mean, root mean square, median, 95th percentile and maximum.
    """

    count: int
    equal: int
    mean: float
    rms: float
    median: float
    p95: float
    max: float


@dataclass(slots=True)
class Comparison:
    """The differences between two files.

    Attributes
    ----------
    matching : str
        ``"index"``: each pixel or point is matched with the same index; ``"nearest"``: each point is matched with the nearest point.
    unit : str
        ``"m"``, or ``"raw"`` for depth images without a camera.
    valid : tuple of 2 ints
        Number of points that are not holes, in each file.
    only_in : tuple of 2 ints
        Number of pixels that are holes only in the other file, for each file.
    distances : Distances
        Distances from each point of the first file to its match.
    back : Distances
        Distances from each point of the second file to the nearest point of the first; ``None`` if points are matched by index.
    fields : dict of str to (is_in, differing)
        Fields that differ: whether each file has the field; and the number of differing values and their largest
        difference.
    """

    matching: str
    unit: str
    valid: tuple[int, int]
    only_in: tuple[int, int]
    distances: Distances
    back: Distances | None
    fields: dict[str, tuple[tuple[bool, bool], tuple[int, float] | None]]


def convert(
    input: Path,
    output: Path,
    *,
    camera: Camera | None = None,
    drop_holes: bool = False,
    fields: Iterable[str] | None = None,
    encoding: Encoding | None = None,
) -> None:
    """Convert a file to the format given by the output's extension, without smoothing.

    Parameters
    ----------
    input, output : path
        The files. Depth images remain depth images in .png, .tiff and .npy, and become organized clouds in other formats.
    camera : Camera, optional
        Camera of a depth image.
    drop_holes : bool
        Leave out holes; an organized cloud becomes unorganized.
    fields : iterable of str, optional
        Fields to keep besides x, y and z [default: all].
    encoding : str, optional
        See `write` [default: the input's].

    Warns
    -----
    RuntimeWarning
        For all data that are dropped, changed or guessed.

    Examples
    --------
    >>> import planish, tempfile, pathlib
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> frame = planish.simulate("table")
    >>> planish.write(folder / "depth.png", frame.depth)
    >>> planish.convert(folder / "depth.png", folder / "cloud.ply", camera=frame.camera)
    >>> planish.read(folder / "cloud.ply").points.shape
    (480, 640, 3)
    """
    names = None if fields is None else [fields] if isinstance(fields, str) else list(fields)
    *_, notes = _planish.convert(input, output, camera, drop_holes, names, [] if encoding is None else [encoding])
    for note in notes:
        warnings.warn(f"{output}: {note}", RuntimeWarning, stacklevel=2)


def compare(a: Path, b: Path, *, camera: Camera | None = None, nearest: bool = False) -> Comparison:
    """Compare two clouds or depth images.

    Parameters
    ----------
    a, b : path
        The files. Pixels and points are compared by index; clouds of different size are compared by nearest points.
    camera : Camera, optional
        Camera of depth images, which are then compared as points.
    nearest : bool
        Compare nearest points instead of points with the same index.

    Examples
    --------
    >>> import planish, tempfile, pathlib
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> frame = planish.simulate("table")
    >>> planish.write(folder / "measured.png", frame.depth)
    >>> planish.write(folder / "smoothed.png", planish.smooth(frame.depth, frame.camera, outputs=["depth"]).depth)
    >>> found = planish.compare(folder / "measured.png", folder / "smoothed.png")
    >>> found.unit, 1 < found.distances.rms < 20
    ('raw', True)
    """
    found: dict[str, Any] = json.loads(_planish.compare_files(a, b, camera, nearest))

    def distances(of: dict[str, Any]) -> Distances:
        values: dict[str, Any] = {name: float("nan") if value is None else value for name, value in of.items()}
        return Distances(**values)

    def differing(of: list[Any] | None) -> tuple[int, float] | None:
        return None if of is None else (of[0], of[1])

    return Comparison(
        matching=found["matching"],
        unit=found["unit"],
        valid=(found["valid"][0], found["valid"][1]),
        only_in=(found["only_in"][0], found["only_in"][1]),
        distances=distances(found["distances"]),
        back=None if found["back"] is None else distances(found["back"]),
        fields={of["name"]: ((of["is_in"][0], of["is_in"][1]), differing(of["differing"])) for of in found["fields"]},
    )


def merge(
    inputs: Iterable[Path],
    output: Path,
    *,
    poses: Iterable[Sequence[float]] | None = None,
    encoding: Encoding | None = None,
) -> int:
    """Merge several clouds into one file, and return its number of points.

    Parameters
    ----------
    inputs : iterable of paths
        The clouds. Holes are omitted; the field ``scan`` contains the index of each point's cloud, from 0.
    output : path
        The cloud to write.
    poses : iterable of sequences of 7 floats, optional
        Pose of each cloud in the common frame: x, y, z, qw, qx, qy, qz [default: all clouds are in one frame].
    encoding : str, optional
        See `write`.
    """
    files = list(inputs)
    placed = None if poses is None else [tuple(float(value) for value in pose) for pose in poses]
    if placed is not None and len(placed) != len(files):
        raise ValueError(f"poses: expected one per input ({len(files)}), not {len(placed)}")
    if placed is not None and any(len(pose) != 7 for pose in placed):
        raise ValueError("poses: expected 7 numbers each: x, y, z, qw, qx, qy, qz")
    if placed is not None and any(abs(sum(value * value for value in pose[3:]) - 1.0) > 1e-3 for pose in placed):
        raise ValueError("poses: expected unit quaternions qw, qx, qy, qz")
    points, notes = _planish.merge(files, output, placed, [] if encoding is None else [encoding])
    for note in notes:
        warnings.warn(f"{output}: {note}", RuntimeWarning, stacklevel=2)
    return points


def mesh(
    input: Path,
    output: Path,
    *,
    camera: Camera | None = None,
    raw: bool = False,
    **settings: Unpack[Settings],
) -> tuple[int, int]:
    """Smooth the frame in a file and connect its pixels into a triangle mesh. Depth steps are not connected.

    Parameters
    ----------
    input : path
        A depth image or an organized cloud.
    output : path
        The mesh to write: .ply, .obj, .stl or .glb.
    camera : Camera, optional
        Camera of a depth image.
    raw : bool
        Connect the measured points, without smoothing.
    **settings : Settings
        See `Settings`.

    Returns
    -------
    tuple of 2 ints
        Numbers of vertices and triangles.
    """
    given = {name: value for name, value in settings.items() if value is not None}
    return _planish.mesh(input, output, camera, raw, given)


def clean(
    cloud: Any,
    *,
    crop: tuple[Sequence[float], Sequence[float]] | None = None,
    voxel: float | None = None,
    statistical: tuple[int, float] | None = None,
    radius_outliers: tuple[float, int] | None = None,
) -> Frame:
    """Crop a cloud, thin it and remove outliers, in the order of the parameters.

    Parameters
    ----------
    cloud : array or Frame
        Points [H, W, 3] or [N, 3] in metres. On a grid, removed points become NaN; otherwise, removed points and holes are omitted.
    crop : (low, high), optional
        Corners of the box to keep: smallest and largest x, y, z.
    voxel : float, optional
        Size of voxels in metres. One point is kept per voxel, and the grid is lost.
    statistical : (neighbours, deviations), optional
        Remove points whose mean distance to their neighbours exceeds the average by more than this many standard deviations.
    radius_outliers : (radius_m, neighbours), optional
        Remove points with fewer neighbours within the radius.

    Examples
    --------
    >>> import planish
    >>> points = planish.simulate("table").points.reshape(-1, 3)
    >>> bool(len(planish.clean(points, voxel=0.01).points) < 0.5 * len(points))
    True
    """
    if all(step is None for step in (crop, voxel, statistical, radius_outliers)):
        raise ValueError("no step is given; use crop, voxel, statistical or radius_outliers")
    fields, pose = (cloud.fields, cloud.pose) if isinstance(cloud, Frame) else (None, None)
    box = None if crop is None else [[float(value) for value in corner] for corner in crop]
    found = _frame(_planish.clean(_cloud(_points(cloud), fields, pose), box, voxel, statistical, radius_outliers))
    return found


def render(cloud: Any, *, direction: Sequence[float] = (0.0, 0.0, 1.0)) -> NDArray[np.uint8]:
    """Render a cloud as a shaded relief, with its colours next to it if it has any. Returns an image [H, W, 3].

    Parameters
    ----------
    cloud : array or Frame
        Points [H, W, 3], seen from their sensor, or points [N, 3].
    direction : sequence of 3 floats
        For points without a grid: direction from the points to the viewer.
    """
    fields, pose = (cloud.fields, cloud.pose) if isinstance(cloud, Frame) else (None, None)
    x, y, z = direction
    return _planish.draw(_cloud(_points(cloud), fields, pose), (float(x), float(y), float(z)))


def prepare(
    depth: NDArray[np.uint16],
    camera: Camera,
    *,
    min_range_m: float | None = None,
    max_range_m: float | None = None,
    remove_floating: bool = False,
    decimate: int | None = None,
    sensor: str = "kinect1",
) -> tuple[NDArray[np.uint16], Camera]:
    """Limit the range, remove floating pixels and reduce the resolution of a depth image, in this order.

    Parameters
    ----------
    depth : ndarray of uint16, [H, W]
        The depth image.
    camera : Camera
        Its camera.
    min_range_m, max_range_m : float, optional
        Minimum and maximum range in metres; pixels outside become holes.
    remove_floating : bool
        Whether pixels that float between two surfaces become holes.
    decimate : int, optional
        Side of the blocks of pixels that are merged into one, 2 to 8. A block becomes the mean of those of its pixels
        that are on the same surface as its median.
    sensor : str
        Sensor whose noise separates surfaces; see `Settings`.

    Returns
    -------
    tuple of ndarray and Camera
        The prepared image, and its camera.

    Examples
    --------
    >>> import planish
    >>> frame = planish.simulate("table")
    >>> depth, camera = planish.prepare(frame.depth, frame.camera, max_range_m=2.0, decimate=2)
    >>> planish.smooth(depth, camera).points.shape
    (240, 320, 3)
    """
    array = _native(as_array(depth))
    if array.ndim != 2 or array.dtype != np.uint16:
        raise TypeError(f"an array of {array.dtype} and shape {list(array.shape)} is not allowed; expected depth [H, W] of uint16")
    given: dict[str, Any] = {"min_range_m": min_range_m, "max_range_m": max_range_m, "decimate": decimate}
    steps = {name: value for name, value in given.items() if value is not None}
    return _planish.prepare(np.ascontiguousarray(array), camera, {"remove_floating": remove_floating, "sensor": sensor, **steps})


def _points(cloud: Any) -> NDArray[Any]:
    array = _native(as_array(cloud))
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind != "f":
        raise TypeError(f"an array of {array.dtype} and shape {list(array.shape)} is not allowed; expected points [H, W, 3] or [N, 3]")
    return array
