"""Conversion of input to numpy arrays that the engines can read in place."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._planish import Camera

# DLPack's device types whose memory the CPU can read: CPU memory, and host memory pinned for CUDA and ROCm.
_HOST_DEVICES = (1, 3, 11)


def as_array(given: Any) -> NDArray[Any]:
    """Return the array of an object, without a copy if possible.

    Accepts numpy arrays, anything with ``__array_interface__``, ``__array__`` or ``__dlpack__`` (torch, cupy, jax), Open3D's clouds, images and
    tensors, structured arrays and data frames with columns x, y and z, and nested sequences. Arrays on a device are copied to the host, with a warning.
    """
    if hasattr(given, "array") and hasattr(given, "fields"):
        # A planish.Frame.
        given = given.array
    given = _of_open3d(given)
    if isinstance(given, np.ma.MaskedArray):
        # Masked values were not measured.
        return _without_names(given.filled(np.nan if given.dtype.kind == "f" else 0))
    if isinstance(given, np.ndarray):
        return _without_names(given)
    if hasattr(given, "columns") and {"x", "y", "z"} <= set(given.columns):
        return np.ascontiguousarray(given[["x", "y", "z"]].to_numpy())
    if hasattr(given, "__dlpack_device__"):
        device, _ = given.__dlpack_device__()
        if int(device) not in _HOST_DEVICES:
            warnings.warn("the array is on a device; it is copied to the host before smoothing", stacklevel=4)
            given = given.cpu() if hasattr(given, "cpu") else given.get()
        if hasattr(given, "detach"):
            given = given.detach()
        if not isinstance(given, np.ndarray):
            return np.from_dlpack(given)
    return _without_names(np.asarray(given))


def _of_open3d(given: Any) -> Any:
    """Return the array of Open3D's clouds, images and tensors."""
    if not type(given).__module__.startswith("open3d"):
        return given
    if hasattr(given, "as_tensor"):
        # An image of Open3D's tensor API.
        given = given.as_tensor()
    if hasattr(given, "point") and hasattr(given.point, "positions"):
        given = given.point.positions
    elif hasattr(given, "points"):
        given = given.points
    return given.cpu().numpy() if hasattr(given, "numpy") else np.asarray(given)


def _without_names(array: NDArray[Any]) -> NDArray[Any]:
    """Convert a structured array with x, y and z to points [.., 3]."""
    if array.dtype.names is None:
        return array
    if not {"x", "y", "z"} <= set(array.dtype.names):
        raise TypeError(f"a structured array needs the fields x, y and z, but this one has {', '.join(array.dtype.names)}")
    return np.stack([array["x"], array["y"], array["z"]], axis=-1)


def as_frame(given: Any, camera: Camera | None) -> tuple[NDArray[Any], bool]:
    """Return the array of a frame, and True if it is a depth image."""
    array = as_array(given)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    is_float = array.dtype.kind == "f"
    is_depth = False
    if array.ndim == 3 and array.shape[2] == 3:
        pass
    elif array.ndim == 2 and array.shape[1] == 3 and is_float and (camera is None or camera.width != 3):
        pass
    elif array.ndim == 2:
        is_depth = True
    else:
        raise ValueError(
            f"a frame of shape {list(array.shape)} is not allowed; expected depth [H, W], points [H, W, 3] or points [N, 3]"
        )
    if is_depth and is_float and array.dtype != np.float32:
        # float32 suffices for depth in metres.
        array = array.astype(np.float32)
    allowed = (np.uint16, np.float32) if is_depth else (np.float32, np.float64)
    if array.dtype.newbyteorder("=") not in allowed:
        expected = "depth must be uint16 (raw values), float32 or float64 (metres)" if is_depth else "points must be float32 or float64"
        raise TypeError(f"an array of {array.dtype} and shape {list(array.shape)} is not allowed; {expected}")
    if 0 in array.shape and array.shape != (0, 3):
        raise ValueError(f"a frame of shape {list(array.shape)} has no pixels")
    if is_depth and camera is None:
        raise ValueError("a depth image needs its camera: camera=planish.Camera(width, height, fx, fy)")
    if is_depth and camera is not None and array.shape != (camera.height, camera.width):
        height, width = array.shape
        raise ValueError(f"the depth image is {width}x{height}, but its camera is {camera.width}x{camera.height}")
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    return _readable(array, is_depth), is_depth


def _readable(array: NDArray[Any], is_depth: bool) -> NDArray[Any]:
    """Return the array if the engines can read it in place, otherwise a contiguous copy."""
    strides, size = array.strides, array.itemsize
    in_order = array.flags.aligned and all(stride >= 0 for stride in strides)
    if is_depth:
        height, width = array.shape
        lies_apart = strides[1] == size and (height < 2 or strides[0] >= width * size) and strides[0] % size == 0
    else:
        # Points must not overlap, and neither must rows.
        span = 2 * strides[-1] + size
        lies_apart = strides[-1] >= size and (array.shape[-2] < 2 or strides[-2] >= span)
        if array.ndim == 3 and array.shape[0] > 1:
            lies_apart = lies_apart and strides[0] >= (array.shape[1] - 1) * strides[1] + span
    return array if in_order and lies_apart else array.copy(order="C")


def origin_of(points: NDArray[Any]) -> tuple[float, float, float] | None:
    """Return an origin near most of the points if float32 would lose relevant digits, otherwise ``None``.

    Up to a kilometre from the origin of coordinates, float32 is accurate to 0.06 mm or better.
    """
    rows = points.reshape(-1, 3)
    sample = rows[:: max(1, len(rows) // 10_000)]
    sample = sample[np.isfinite(sample).all(axis=-1)]
    if not len(sample):
        return None
    x, y, z = (float(value) for value in np.round(np.median(sample, axis=0)))
    return (x, y, z) if max(abs(x), abs(y), abs(z)) > 1000.0 else None
