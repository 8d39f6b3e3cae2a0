"""Smoothing: one call, or a smoother that keeps its engine and buffers."""

from __future__ import annotations

import os
import threading
import warnings
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ._arrays import as_array, as_frame, origin_of
from ._planish import Camera, Engine
from ._result import CloudChoice, Smoothed
from ._settings import Output, Settings

if TYPE_CHECKING:
    from typing_extensions import Unpack

Pose = Sequence[float]

# The settings that change a frame before it is smoothed.
PREPARATION = ("remove_floating", "min_range_m", "max_range_m", "decimate")

_OUTPUTS: dict[str, tuple[type[np.generic], bool]] = {
    # The type of each output's values, and whether a value is a vector.
    "points": (np.float32, True),
    "normals": (np.float32, True),
    "curvature": (np.float32, False),
    "status": (np.uint8, False),
    "neighbours": (np.uint32, False),
    "depth": (np.uint16, False),
    "depth_m": (np.float32, False),
    "frames": (np.float32, False),
    "sigma": (np.float32, False),
}


@dataclass(slots=True)
class _Kind:
    """Shape and type of a frame's result."""

    shape: tuple[int, ...]
    points: DTypeLike
    origin: tuple[float, float, float] | None


class Smoother:
    """An open engine with its buffers, for smoothing many frames.

    The engine opens with the first frame, whose resolution determines stride and window, and reopens if the shape, camera or pose of the
    frames changes. Use a smoother in one thread at a time; open one per thread. Pickling keeps its settings, not its buffers.

    Parameters
    ----------
    camera : Camera, optional
        Camera of depth images, and of organized points if depth is requested.
    outputs : iterable of str
        Any of ``"points"``, ``"normals"``, ``"curvature"``, ``"status"``, ``"neighbours"``, ``"depth"`` (uint16), ``"depth_m"``,
        ``"sigma"`` and, with ``temporal``, ``"frames"``. Fewer outputs are faster.
    **settings : Settings
        ``preset``, ``strength``, ``sensor``, ``edges``, ``engine``, ...; see `Settings`. ``planish.read_settings`` reads them from a
        file.

    Examples
    --------
    >>> import planish
    >>> frame = planish.simulate("room", seed=2)
    >>> smoother = planish.Smoother(camera=frame.camera, preset="strong")
    >>> result = smoother.smooth(frame.depth)
    >>> bool((result.status >= planish.Status.PLANE).mean() > 0.9)
    True
    """

    # Whether only one frame is smoothed; `auto` then opens a GPU only for a large frame.
    _is_single = False

    def __init__(
        self,
        camera: Camera | None = None,
        *,
        outputs: Iterable[Output] = ("points", "normals", "status"),
        **settings: Unpack[Settings],
    ) -> None:
        if camera is not None and not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a planish.Camera, not {type(camera).__name__}")
        for name in PREPARATION:
            if settings.get(name):
                raise ValueError(f"{name}: applies only to streams and the command; call planish.prepare before the Smoother")
        self._camera = camera
        self._outputs = _checked_outputs(outputs)
        self._settings: dict[str, Any] = {name: value for name, value in settings.items() if value is not None}
        # Use a separate pool, since shared threads do not survive a fork.
        own_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self._engine = Engine({"threads": own_threads, **self._settings}, self._is_single)
        # Settings that have no effect on points without a grid, reported once.
        self._unused = self._engine.unused_by_clouds()
        # The kind of each frame in flight, and its points if they are float64.
        self._in_flight: deque[tuple[_Kind, NDArray[Any] | None]] = deque()
        self._order = threading.Lock()

    @property
    def camera(self) -> Camera | None:
        """The camera of depth images."""
        return self._camera

    @property
    def engine(self) -> str | None:
        """The name of the open engine and of its GPU; ``None`` before the first frame."""
        name, gpu, _ = self._engine.opened()
        return f"{name}, {gpu}" if gpu else name

    @property
    def chosen_because(self) -> str | None:
        """The reason for the choice of ``engine="auto"``."""
        return self._engine.opened()[2]

    @property
    def cloud_choice(self) -> CloudChoice | None:
        """The choices for the last unorganized cloud, and its noise; ``None`` if the settings made the choices, if a
        sensor was recognized, or after a frame on a grid."""
        choice, _ = self._engine.chosen_for_cloud()
        return CloudChoice(*choice) if choice else None

    @property
    def rebuilt_grid(self) -> tuple[int, int] | None:
        """Height and width of the rebuilt grid on which the last cloud was smoothed; ``None`` if no grid was rebuilt."""
        return self._engine.chosen_for_cloud()[1]

    def smooth(
        self,
        frame: Any,
        out: Smoothed | Mapping[str, NDArray[Any]] | None = None,
        *,
        pose: Pose | None = None,
        camera_pose: Pose | None = None,
    ) -> Smoothed:
        """Smooth a frame.

        Parameters
        ----------
        frame : array
            Depth [H, W], uint16 in the camera's units or float32 in metres; organized points [H, W, 3], or an unorganized cloud [N, 3], float32 or
            float64 in metres. Holes are 0 in depth and NaN in points. Arrays are read in place with any strides; objects with
            ``__array_interface__`` or ``__dlpack__``, and data frames with columns x, y and z, are accepted too.
        out : Smoothed or mapping of str to ndarray, optional
            C-contiguous arrays to write into instead of new ones; they determine the outputs.
        pose : sequence of 7 floats, optional
            Pose of the sensor in the frame of the points: x, y, z, qw, qx, qy, qz.
        camera_pose : sequence of 7 floats, optional
            With ``temporal="steady"``: pose of a moving camera in the world, for depth and for points in the camera's frame. Each pixel then
            follows its surface over time.

        Returns
        -------
        Smoothed
            The result. With `out`, it refers to the given arrays.

        Raises
        ------
        TypeError
            If an array has an unsupported type.
        ValueError
            If a shape is wrong, a parameter is out of range, or arrays overlap or are read-only.
        RuntimeError
            If an engine is unavailable or fails, or another thread uses this smoother.
        """
        array, is_depth = as_frame(frame, self._camera)
        kind = _kind_of(array, is_depth)
        if self._unused and len(kind.shape) == 1:
            verb = "has" if len(self._unused) == 1 else "have"
            text = f"{', '.join(self._unused)} {verb} no effect on points without a grid"
            self._unused = []
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        arrays = _new_arrays(self._outputs, kind) if out is None else _given_arrays(out, kind)
        if is_depth and pose is not None:
            raise ValueError("pose: depth images are in their camera's frame; give the pose with points, or camera_pose")
        if out is not None and any(np.may_share_memory(array, other) for other in arrays.values()):
            raise ValueError("out: an array overlaps the input")
        # The engine writes float32; points of other types are converted.
        written = {name: _written(name, array) for name, array in arrays.items()}
        place = (self._camera, _checked_pose(pose), kind.origin, self._checked_camera_pose(camera_pose))
        for event in self._engine.smooth(array, is_depth, place, written):
            warnings.warn(event, RuntimeWarning, stacklevel=2)
        return _finished(arrays, written, array, kind)

    def submit(self, frame: Any, *, pose: Pose | None = None, camera_pose: Pose | None = None) -> None:
        """Submit a frame without waiting for its result. A GPU computes it asynchronously.

        The frame may be modified as soon as this method returns. At most `max_in_flight` frames may be in flight.
        """
        array, is_depth = as_frame(frame, self._camera)
        kind = _kind_of(array, is_depth)
        kinds = {name: np.empty(0, _OUTPUTS[name][0]) for name in self._outputs}
        with self._order:
            place = (self._camera, _checked_pose(pose), kind.origin, self._checked_camera_pose(camera_pose))
            self._engine.submit(array, is_depth, place, kinds)
            self._in_flight.append((kind, array.copy() if kind.points == np.float64 else None))

    def receive(self) -> Smoothed | None:
        """Wait for the oldest frame in flight and return its result; ``None`` if no frame is in flight."""
        with self._order:
            if not self._in_flight:
                return None
            kind, measured = self._in_flight[0]
            arrays = _new_arrays(self._outputs, kind)
            written = {name: _written(name, array) for name, array in arrays.items()}
            try:
                received = self._engine.receive(written)
            except Exception:
                # The engine is closed, and all frames in flight are lost.
                self._in_flight.clear()
                raise
            self._in_flight.popleft()
        return _finished(arrays, written, measured, kind) if received else None

    @property
    def in_flight(self) -> int:
        """Number of frames in flight."""
        return self._engine.in_flight()[0]

    @property
    def max_in_flight(self) -> int:
        """Maximum number of frames in flight; 1 before the first frame."""
        return self._engine.in_flight()[1]

    def smooth_batch(
        self,
        frames: Any,
        out: Mapping[str, NDArray[Any]] | None = None,
    ) -> Smoothed:
        """Smooth frames of one shape, as many at once as the engine allows.

        Parameters
        ----------
        frames : array or sequence of arrays
            Depth [B, H, W] or organized points [B, H, W, 3], or a sequence of frames.
        out : mapping of str to ndarray, optional
            C-contiguous arrays to write into; the first dimension is the index of the frame.

        Returns
        -------
        Smoothed
            Arrays whose first dimension is the index of the frame.
        """
        if not isinstance(frames, (np.ndarray, Sequence)):
            # A generator may reuse its buffer.
            frames = [as_array(frame).copy() for frame in frames]
        given = [as_frame(frame, self._camera) for frame in frames]
        kinds = {(array.shape, array.dtype.str, is_depth) for array, is_depth in given}
        if len(kinds) > 1:
            raise ValueError(f"frames of a batch must have the same shape and type, but these have {len(kinds)} different ones")
        if not given:
            raise ValueError("a batch needs at least one frame")
        kind = _kind_of(*given[0])
        kind = _Kind((len(given), *kind.shape), kind.points, None)
        arrays = _new_arrays(self._outputs, kind) if out is None else _given_arrays(out, kind)
        outs = [{name: array[i] for name, array in arrays.items()} for i in range(len(given))]
        if any(np.may_share_memory(array, other) for array, _ in given for other in arrays.values()):
            raise ValueError("out: an array overlaps a frame")
        if kind.points == np.float64:
            for (array, _), out_of_frame in zip(given, outs, strict=True):
                self.smooth(array, out=out_of_frame)
        else:
            for event in self._engine.smooth_batch([array for array, _ in given], given[0][1], self._camera, outs):
                warnings.warn(event, RuntimeWarning, stacklevel=2)
        return Smoothed(**arrays)

    @property
    def camera_motion(self) -> tuple[float, ...] | None:
        """Motion of the camera from the previous frame to the current one, as given or estimated with ``track=True``: pose of the current camera
        in the frame of the previous camera (x, y, z, qw, qx, qy, qz). ``None`` if unknown."""
        motion = self._engine.camera_motion()
        return None if motion is None else tuple(motion)

    def restart_video(self) -> None:
        """With ``temporal="steady"``, forget all previous frames, for example after a gap in time or after the camera was moved."""
        self._engine.restart_video()

    def _checked_camera_pose(self, pose: Pose | None) -> tuple[float, ...] | None:
        if pose is not None and (self._settings.get("temporal") != "steady" or self._settings.get("track")):
            raise ValueError('camera_pose: applies only with temporal="steady" and without track')
        return _checked_pose(pose, "camera_pose")

    def close(self) -> None:
        """Close the engine and free its memory; the next frame opens it again."""
        with self._order:
            self._engine.close()
            self._in_flight.clear()

    def __enter__(self) -> Smoother:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {"camera": self._camera, "outputs": self._outputs, **self._settings}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Smoother.__init__(self, **state)

    def __repr__(self) -> str:
        given = {"camera": self._camera, **self._settings, "outputs": list(self._outputs)}
        texts = [f"{name}={value!r}" for name, value in given.items() if value is not None]
        return f"Smoother({', '.join(texts)})"


class _SingleFrame(Smoother):
    _is_single = True


def smooth(
    frame: Any,
    camera: Camera | None = None,
    *,
    pose: Pose | None = None,
    outputs: Iterable[Output] = ("points", "normals", "status"),
    **settings: Unpack[Settings],
) -> Smoothed:
    """Smooth one frame. For many frames, open a `Smoother`, which keeps its engine and buffers.

    Here, ``engine="auto"`` uses the CPU unless the frame is large (over six million pixels, or over half a million points in a cloud), because
    opening a GPU takes longer than smoothing a small frame.

    Parameters
    ----------
    frame : array
        Depth [H, W] (uint16 or float32), points [H, W, 3] or [N, 3] (float32 or float64); see `Smoother.smooth`.
    camera : Camera, optional
        Camera of a depth image.
    pose : sequence of 7 floats, optional
        Pose of the sensor in the frame of the points: x, y, z, qw, qx, qy, qz.
    outputs : iterable of str
        Requested outputs; see `Smoother`.
    **settings : Settings
        ``preset``, ``strength``, ``sensor``, ``radius_m``, ``neighbours``, ``edges``, ``engine``, ...; see `Settings`.

    Returns
    -------
    Smoothed

    Examples
    --------
    An unorganized cloud:

    >>> import numpy as np, planish
    >>> rng = np.random.default_rng(1)
    >>> points = np.column_stack([rng.random((5000, 2)), rng.normal(0, 0.004, 5000)]).astype(np.float32)
    >>> result = planish.smooth(points)
    >>> bool(np.std(result.points[:, 2]) < 0.5 * np.std(points[:, 2]))
    True
    """
    over_time = [name for name in ("temporal", "track") if settings.get(name) not in (None, "off", False)]
    if over_time:
        warnings.warn(f"{', '.join(over_time)}: no effect on a single frame; use a Smoother", RuntimeWarning, stacklevel=2)
    with _SingleFrame(camera, outputs=outputs, **settings) as smoother:
        return smoother.smooth(frame, pose=pose)


def _checked_outputs(outputs: Iterable[str]) -> tuple[str, ...]:
    if isinstance(outputs, str):
        raise TypeError(f"outputs: expected a list of names, such as [{outputs!r}]")
    names = tuple(dict.fromkeys(outputs))
    unknown = [name for name in names if name not in _OUTPUTS]
    if unknown or not names:
        found = f"{unknown[0]!r} is not allowed" if unknown else "none given"
        raise ValueError(f"outputs: {found}; expected some of {', '.join(_OUTPUTS)}")
    return names


def _checked_pose(pose: Pose | None, name: str = "pose") -> tuple[float, ...] | None:
    if pose is None:
        return None
    values = tuple(float(value) for value in pose)
    if len(values) != 7:
        raise ValueError(f"{name}: expected 7 numbers (x, y, z, qw, qx, qy, qz), not {len(values)}")
    return values


def _kind_of(array: NDArray[Any], is_depth: bool) -> _Kind:
    if is_depth or array.dtype == np.float32:
        return _Kind(array.shape[:2] if is_depth else array.shape[:-1], np.float32, None)
    return _Kind(array.shape[:-1], np.float64, origin_of(array))


def _shape_of(name: str, kind: _Kind) -> tuple[int, ...]:
    return (*kind.shape, 3) if _OUTPUTS[name][1] else kind.shape


def _new_arrays(names: Iterable[str], kind: _Kind) -> dict[str, NDArray[Any]]:
    def dtype_of(name: str) -> DTypeLike:
        return kind.points if name == "points" else _OUTPUTS[name][0]

    return {name: np.empty(_shape_of(name, kind), dtype_of(name)) for name in names}


def _given_arrays(out: Smoothed | Mapping[str, NDArray[Any]], kind: _Kind) -> dict[str, NDArray[Any]]:
    """Check the caller's arrays."""
    if isinstance(out, Smoothed):
        given = {name: getattr(out, name) for name in _OUTPUTS if getattr(out, name) is not None}
    elif isinstance(out, Mapping):
        given = dict(out)
    else:
        raise TypeError(f"out: expected a planish.Smoothed or a dict of arrays, not {type(out).__name__}")
    _checked_outputs(given)
    for name, array in given.items():
        dtype = kind.points if name == "points" else _OUTPUTS[name][0]
        if not isinstance(array, np.ndarray):
            raise TypeError(f"out[{name!r}]: expected a numpy array, not {type(array).__name__}")
        if array.dtype != dtype:
            raise TypeError(f"out[{name!r}]: expected an array of {np.dtype(dtype)}, not of {array.dtype}")
        if array.shape != _shape_of(name, kind):
            raise ValueError(f"out[{name!r}]: expected the shape {list(_shape_of(name, kind))}, not {list(array.shape)}")
        if not array.flags.writeable:
            raise ValueError(f"out[{name!r}]: the array is read-only")
        if not array.flags.c_contiguous or not array.flags.aligned:
            raise ValueError(f"out[{name!r}]: the array must be C-contiguous")
    arrays = list(given.values())
    for i, array in enumerate(arrays):
        if any(np.may_share_memory(array, other) for other in arrays[:i]):
            raise ValueError("out: two arrays overlap")
    return given


def _written(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return the array that the engine writes for an output: the given array if its type fits, otherwise a new one."""
    return array if array.dtype == _OUTPUTS[name][0] else np.empty(array.shape, _OUTPUTS[name][0])


def _finished(
    arrays: dict[str, NDArray[Any]], written: dict[str, NDArray[Any]], measured: NDArray[Any] | None, kind: _Kind
) -> Smoothed:
    """Build the result, with points of the input type. For float64, displacements are added to the measured points, which keeps all digits."""
    points = arrays.get("points")
    if points is not None and points is not written["points"] and measured is not None:
        relative = measured if kind.origin is None else measured - kind.origin
        np.add(measured, written["points"] - relative.astype(np.float32), out=points)
    return Smoothed(**arrays)
