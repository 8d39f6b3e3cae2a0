"""Streams: frames of a camera, a recording or a folder, smoothed as they arrive."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ._drivers import find_realsense
from ._planish import Camera
from ._planish import Stream as _Stream
from ._result import Smoothed, described
from ._settings import Output, Settings
from ._smoothing import PREPARATION, Smoother

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(slots=True, eq=False, repr=False)
class StreamFrame:
    """A frame of a stream with its result.

    Attributes
    ----------
    smoothed : Smoothed
        The result.
    depth : ndarray of uint16, [H, W]
        The measured depth image; ``None`` for a cloud.
    points : ndarray of float32, [H, W, 3]
        The measured points; ``None`` for a depth image.
    rgb : ndarray of uint8, [H, W, 3]
        Colour registered to the depth image, if available.
    camera : Camera
        Camera of a depth image.
    index : int
        Index among the smoothed frames, from 0.
    name : str
        File name without extension, for frames from files.
    timestamp_s : float
        Time of capture in seconds on the source's clock, if known.
    latency_s : float
        Time in seconds from the frame's arrival to its result.
    """

    smoothed: Smoothed
    index: int
    latency_s: float
    depth: NDArray[np.uint16] | None = None
    points: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None
    camera: Camera | None = None
    name: str | None = None
    timestamp_s: float | None = None

    def __repr__(self) -> str:
        return described(self)


class Stream:
    """A running stream, opened by `stream`. Iterate over it; close it, or use it in a ``with`` block."""

    def __init__(self, running: _Stream) -> None:
        self._running = running
        self._warned: set[str] = set()
        # The frame that was received but not delivered, because a warning was raised as an error.
        self._taken: dict[str, Any] | None = None

    def __iter__(self) -> Iterator[StreamFrame]:
        return self

    def __next__(self) -> StreamFrame:
        has_ended = False
        while self._taken is None and not has_ended:
            self._taken, messages, has_ended = self._running.next()
            for message in messages:
                if message not in self._warned:
                    self._warned.add(message)
                    warnings.warn(message, RuntimeWarning, stacklevel=2)
        found, self._taken = self._taken, None
        if found is None:
            raise StopIteration
        return StreamFrame(smoothed=Smoothed(**found.pop("smoothed")), **found)

    @property
    def is_live(self) -> bool:
        """True for a camera or a source played at a fixed rate; a waiting frame is then replaced by a newer one."""
        return self._running.is_live()

    @property
    def statistics(self) -> dict[str, Any] | None:
        """Counts, frames per second and latency of the stream; ``None`` before its end."""
        return self._running.statistics()

    def close(self) -> None:
        """End the stream and wait for its threads."""
        self._running.close()

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def stream(
    source: str | PathLike[str] = "synthetic",
    camera: Camera | None = None,
    *,
    outputs: Iterable[Output] = ("points", "status"),
    fps: float | None = None,
    frames: int | None = None,
    depth_units_per_metre: float | None = None,
    align: Literal["depth", "color", "none"] | None = None,
    mode: str | None = None,
    topic: str | None = None,
    poses: str | PathLike[str] | None = None,
    pose_topic: str | None = None,
    fixed_frame: str | None = None,
    **settings: Unpack[Settings],
) -> Stream:
    """Smooth frames as they arrive. Capture and smoothing run in background threads while Python processes the previous frame.

    Parameters
    ----------
    source : str or path
        A camera (``"realsense"``, ``"openni2"``, ``"kinect"``), ``"synthetic"``, a recording of a camera (``"realsense:walk.bag"``,
        ``"openni2:walk.oni"``), or a path: a folder of frames, a TUM data set, a fakenect recording, a file. A RealSense needs
        librealsense2, which the package pyrealsense2 includes.
    camera : Camera, optional
        Camera of depth images whose source does not state one.
    outputs : iterable of str
        Requested outputs; see `Smoother`.
    fps : float, optional
        Play at this rate, like a camera: frames that arrive while Python is busy are dropped. Without a rate, a file or folder waits and no frame is lost.
    frames : int, optional
        Maximum number of frames.
    depth_units_per_metre : float, optional
        Raw depth value of 1 m, for a data set that does not state its depth unit.
    align : {"depth", "color", "none"}, optional
        For RealSense and OpenNI2 cameras: the image that depth and colour are mapped to. ``"depth"`` maps colour to depth (default
        of a RealSense), ``"color"`` maps depth to colour (default of OpenNI2 cameras that support it), and ``"none"`` omits colour.
    mode : str, optional
        For RealSense and OpenNI2 cameras: size and rate of the depth stream, such as ``"848x480@30"``.
    topic : str, optional
        For an MCAP recording: the topic with depth images or clouds, if there are several.
    poses : str or path, optional
        Poses of a moving camera, with ``temporal="steady"``: TUM's ``groundtruth.txt``, by time, or ``trajectory.log``, by frame.
    pose_topic : str, optional
        For an MCAP recording, with ``temporal="steady"``: the topic with the poses of a moving camera, such as ``"/tf"`` or a
        topic with odometry.
    fixed_frame : str, optional
        The fixed coordinate frame, with ``pose_topic`` [default: odom, or the root of the camera's frames].
    **settings : Settings
        ``preset``, ``strength``, ``sensor``, ``edges``, ``engine``, ...; see `Settings`.

    Returns
    -------
    Stream
        An iterator of `StreamFrame`.

    Examples
    --------
    >>> import planish
    >>> with planish.stream("synthetic", frames=3, outputs=["depth"]) as frames:
    ...     for frame in frames:
    ...         changed = (frame.smoothed.depth != frame.depth).mean()
    >>> frame.index, bool(changed > 0.5)
    (2, True)
    """
    if camera is not None and not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a planish.Camera, not {type(camera).__name__}")
    if frames is not None and not isinstance(frames, int):
        raise TypeError(f"frames: expected a whole number, not {type(frames).__name__}")
    if frames is not None and not 0 <= frames < 2**63:
        raise ValueError(f"frames: {frames} is not allowed: 0 to 2**63 - 1")
    if not isinstance(source, str) and not os.path.exists(source):
        raise FileNotFoundError(f"{os.fspath(source)}: no such file or folder")
    if poses is not None and pose_topic is not None:
        raise ValueError("poses and pose_topic cannot be combined; give one of them")
    if fixed_frame is not None and pose_topic is None:
        raise ValueError("fixed_frame has no effect without pose_topic")
    find_realsense(os.fspath(source))
    # Check the settings as a Smoother does.
    of_smoother: dict[str, Any] = {name: value for name, value in settings.items() if name not in PREPARATION}
    checked = Smoother(camera, outputs=outputs, **of_smoother)
    names = list(checked.__getstate__()["outputs"])
    file = None if poses is None else os.fspath(poses)
    of_source = (fps, frames, depth_units_per_metre, align, mode, topic)
    return Stream(_Stream(os.fspath(source), names, dict(settings), camera, *of_source, file, pose_topic, fixed_frame))
