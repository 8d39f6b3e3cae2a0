"""Files, simulated frames, scores and devices."""

from __future__ import annotations

import errno
import json
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import _planish
from ._arrays import as_array, origin_of
from ._planish import Camera
from ._result import described


Encoding = Literal[
    "binary", "ascii", "compressed", "f32", "f64",
    "binary,f32", "binary,f64", "ascii,f32", "ascii,f64", "compressed,f32", "compressed,f64",
]


Unit = Literal["mm", "cm", "m", "inch", "ft"]


@dataclass(slots=True, eq=False, repr=False)
class Frame:
    """Contents of a file: a depth image, or points.

    Attributes
    ----------
    format : str
        Name of the file's format.
    depth : ndarray, [H, W]
        Raw values (uint16, holes 0) or metres (float32, holes NaN); ``None`` for points.
    points : ndarray, [H, W, 3] or [N, 3]
        Metres, holes NaN; float32, or float64 if coordinates exceed a kilometre; ``None`` for depth.
    fields : dict of str to ndarray
        All other fields of the points: colour, intensity, label, ..., [H, W] or [N].
    camera : Camera
        The camera, if the file states it.
    pose : tuple of 7 floats
        Pose of the sensor: x, y, z, qw, qx, qy, qz; ``None`` if the file does not state it.
    """

    format: str
    depth: NDArray[Any] | None = None
    points: NDArray[Any] | None = None
    fields: dict[str, NDArray[Any]] = field(default_factory=dict)
    camera: Camera | None = None
    pose: tuple[float, ...] | None = None

    @property
    def array(self) -> NDArray[Any]:
        """The depth or the points, as accepted by `planish.smooth`."""
        if self.depth is not None:
            return self.depth
        if self.points is None:
            raise ValueError("the frame has neither depth nor points")
        return self.points

    def __repr__(self) -> str:
        return described(self)


@dataclass(slots=True, eq=False, repr=False)
class Simulated:
    """A simulated depth image with its ground truth.

    Attributes
    ----------
    depth : ndarray of uint16, [H, W]
        Raw depth with the sensor's noise, 0 for holes.
    camera : Camera
        The camera that took it.
    points, normals : ndarray of float32, [H, W, 3]
        The true surface in metres; NaN for pixels that see no surface.
    """

    depth: NDArray[np.uint16]
    camera: Camera
    points: NDArray[np.float32]
    normals: NDArray[np.float32]

    def __repr__(self) -> str:
        return described(self)


@dataclass(slots=True)
class Devices:
    """The engines of this machine.

    Attributes
    ----------
    gpus : list of (index, name, kind)
        Every adapter, including software renderers.
    auto : str
        The choice of ``engine="auto"``.
    reason : str
        The reason for the choice.
    """

    gpus: list[tuple[int, str, str]]
    auto: str
    reason: str


def read(path: str | PathLike[str], *, unit: Unit | None = None, columns: int | None = None, image: int | None = None) -> Frame:
    """Read a cloud or a depth image: PCD, PLY, LAS, LAZ, E57, PTX, text, CSV, NPY, NPZ, lidar .bin, OBJ, OFF, STL, PNG, TIFF, ....

    Parameters
    ----------
    path : path
        The file.
    unit : {"mm", "cm", "m", "inch", "ft"}, optional
        Unit of points and of floating-point depth in files that do not state one; values are converted to metres [default: m].
    columns : int, optional
        Number of columns of a lidar's .bin [default: detected from the values].
    image : int, optional
        Number, counted from 1, of the image to read from a TIFF file with several pages or from a .npy file of shape
        [N, H, W] [default: 1].

    Warns
    -----
    RuntimeWarning
        If data were dropped or guessed.

    Raises
    ------
    OSError
        If the file does not exist (``FileNotFoundError``) or cannot be read.
    ValueError
        If the contents violate the file's format.
    """
    return _frame(_planish.read(path, unit, columns, image))


# Extensions of the formats that store the sensor's pose, and of those that store rows and columns.
_WITH_POSES = (".pcd", ".ply")
_WITH_GRIDS = (".pcd", ".ply", ".npy", ".npz")


def write(
    path: str | PathLike[str],
    data: Any,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    pose: Iterable[float] | None = None,
    encoding: Encoding = "binary",
) -> None:
    """Write points or a depth image; the extension determines the format.

    Parameters
    ----------
    path : path
        ``.pcd``, ``.ply``, ``.las``, ``.laz``, ``.xyz``, ``.csv``, ``.npy``, ... for points, ``.png``, ``.tiff`` or ``.npy`` for depth.
    data : array or Frame
        Points [H, W, 3] or [N, 3], or depth [H, W] (uint16, or float32 in metres).
    fields : mapping of str to array, optional
        One value per point: ``{"intensity": ..., "normal_x": ...}``.
    pose : sequence of 7 floats, optional
        Pose of the sensor: x, y, z, qw, qx, qy, qz.
    encoding : {"binary", "ascii", "compressed", "f32", "f64"}
        Encoding of .pcd and .ply, size of their coordinates, or both separated by a comma (``"compressed,f64"``). Coordinates have 4 bytes (f32)
        by default, or 8 bytes (f64) if they exceed a kilometre; PCL reads 8-byte coordinates in .pcd as zeros.

    Warns
    -----
    RuntimeWarning
        If the format cannot store the pose or the grid.
    """
    folder = Path(path).parent
    if not folder.is_dir():
        raise FileNotFoundError(errno.ENOENT, "no such folder", str(folder))
    if isinstance(data, Frame):
        fields = {**data.fields, **(fields or {})}
        pose = data.pose if pose is None else pose
        data = data.array
    array = _native(as_array(data))
    if fields and Path(path).suffix.lower() == ".npy":
        raise ValueError(f"{path}: an .npy file cannot store fields; write .npz")
    if array.ndim == 2 and (array.dtype == np.uint16 or (array.dtype == np.float32 and array.shape[1] != 3)):
        if fields or pose is not None:
            raise ValueError("a depth image cannot store fields or a pose")
        if array.dtype == np.float32 and Path(path).suffix.lower() != ".npy":
            raise ValueError(f"{path}: depth in metres can be written only to .npy; give raw values (uint16) for .png and .tiff")
        _planish.write_depth(path, np.ascontiguousarray(array))
        return
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind != "f":
        raise ValueError(
            f"an array of {array.dtype} and shape {list(array.shape)} is not allowed; expected points [H, W, 3] or [N, 3], or depth [H, W] of uint16 or float32"
        )
    rows, origin, grid, flat, pose = _cloud(array, fields, pose)
    _planish.write_points(path, rows, origin, grid, flat, pose, encoding)
    suffix = Path(path).suffix.lower()
    lost = ["the sensor's pose"] if pose is not None and suffix not in _WITH_POSES else []
    lost += ["the grid"] if grid is not None and suffix not in _WITH_GRIDS else []
    if lost:
        warnings.warn(f"{path}: {suffix} cannot store {' and '.join(lost)}; .pcd can", RuntimeWarning, stacklevel=2)


_Cloud = tuple[
    NDArray[np.float64], tuple[float, float, float], tuple[int, int] | None, dict[str, NDArray[Any]], tuple[float, ...] | None
]


def _cloud(array: NDArray[Any], fields: Mapping[str, NDArray[Any]] | None, pose: Iterable[float] | None) -> _Cloud:
    """Return points and their fields in the form that the extension module expects."""
    grid = (array.shape[0], array.shape[1]) if array.ndim == 3 else None
    flat = {}
    for name, values in (fields or {}).items():
        values = _plain(np.asarray(values))
        if values.shape[: array.ndim - 1] != array.shape[:-1] or values.ndim > array.ndim:
            raise ValueError(f"fields[{name!r}]: expected the shape {list(array.shape[:-1])}, not {list(values.shape)}")
        flat[name] = np.ascontiguousarray(values).reshape(-1)
    rows = np.ascontiguousarray(array, dtype=np.float64).reshape(-1, 3)
    return rows, origin_of(rows) or (0.0, 0.0, 0.0), grid, flat, None if pose is None else tuple(pose)


def _native(array: NDArray[Any]) -> NDArray[Any]:
    """Convert to this machine's byte order."""
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def _frame(found: dict[str, Any]) -> Frame:
    """Build a frame from the output of the extension module."""
    grid = found.pop("grid", None)
    if grid is not None:
        found["points"] = found["points"].reshape(*grid, 3)
        found["fields"] = {name: values.reshape(*grid, *values.shape[1:]) for name, values in found["fields"].items()}
    if "pose" in found:
        found["pose"] = tuple(found["pose"])
    return Frame(**{"format": "", **found})


def _plain(values: NDArray[Any]) -> NDArray[Any]:
    """Convert to a type that files support."""
    if values.dtype == np.bool_:
        return values.astype(np.uint8)
    if values.dtype == np.float16:
        return values.astype(np.float32)
    return values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("="))


def info(path: str | PathLike[str]) -> dict[str, Any]:
    """Summarize a file.

    Examples
    --------
    >>> import planish, tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "depth.png"
    >>> planish.write(file, planish.simulate("table").depth)
    >>> planish.info(file)["shape"]
    (480, 640)
    """
    frame = read(path)
    array = frame.array
    valid = np.isfinite(array).all(axis=-1) if frame.points is not None else np.isfinite(array) & (array != 0)
    found: dict[str, Any] = {
        "format": frame.format,
        "kind": "depth" if frame.depth is not None else ("organized" if array.ndim == 3 else "general"),
        "shape": array.shape[:2] if frame.depth is not None else array.shape[:-1],
        "dtype": str(array.dtype),
        "valid": int(valid.sum()),
        "fields": {name: str(values.dtype) for name, values in frame.fields.items()},
        "camera": frame.camera,
        "pose": frame.pose,
    }
    if valid.any():
        values = array[valid]
        found["least"], found["largest"] = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    return found


def simulate(
    scene: Literal["table", "room", "shapes", "curves"] = "table",
    *,
    seed: int = 1,
    camera: Camera | None = None,
    sensor: str = "kinect1",
    index: int = 0,
) -> Simulated:
    """Simulate a depth image of a known scene with the noise of a sensor. The same arguments give the same image.

    Parameters
    ----------
    scene : {"table", "room", "shapes", "curves"}
        The scene. ``curves`` has cylinders, spheres, a torus, a saddle and a board at 1.2 m.
    seed : int
        Seed of scene and noise.
    camera : Camera, optional
        The camera [default: a Kinect v1].
    sensor : str
        Sensor whose noise to simulate; see `Settings`.
    index : int
        Index of the image in a series of the static scene.
    """
    camera = Camera.kinect_v1() if camera is None else camera
    depth, points, normals = _planish.simulate(scene, seed, camera, sensor, index)
    return Simulated(depth, camera, points, normals)


def evaluate(*, seeds: Iterable[int] = (1,), **settings: Any) -> dict[str, Any]:
    """Smooth simulated frames and measure the result against the truth, as ``planish evaluate`` does.

    Parameters
    ----------
    seeds : iterable of int
        Seeds of the scenes; each seed gives three frames.
    **settings
        See `Settings`.

    Returns
    -------
    dict
        ``"raw"`` and ``"smoothed"``, each with errors by range, edges, shapes and lost pixels, in millimetres and
        degrees.
    """
    scores: dict[str, Any] = json.loads(_planish.evaluate(dict(settings), [int(seed) for seed in seeds]))
    return scores


def devices() -> Devices:
    """List the GPUs of this machine, and the choice of ``engine="auto"``."""
    return Devices(*_planish.devices())
