"""planish: smooth depth frames and point clouds by Moving Least Squares, fast enough for every frame.

One call:

>>> import planish
>>> frame = planish.simulate("table")
>>> result = planish.smooth(frame.depth, frame.camera)
>>> result.points.shape, result.normals.shape
((480, 640, 3), (480, 640, 3))

Many frames, with reused buffers:

>>> with planish.Smoother(camera=frame.camera, outputs=["depth"]) as smoother:
...     for _ in range(3):
...         depth = smoother.smooth(frame.depth).depth
>>> depth.dtype, depth.shape
(dtype('uint16'), (480, 640))
"""

from ._cuda import CudaSmoother
from ._files import Devices, Frame, Simulated, devices, evaluate, info, read, simulate, write
from ._planish import VERSION as __version__
from ._planish import Camera, CudaArray
from ._result import CloudChoice, Origin, Smoothed, Status
from ._settings import Sensor, Settings, SettingsFile, read_settings, write_settings
from ._smoothing import Smoother, smooth
from ._stream import Stream, StreamFrame, stream
from ._tools import Comparison, Distances, clean, compare, convert, merge, mesh, prepare, render

__all__ = [
    "Camera",
    "CloudChoice",
    "Comparison",
    "CudaArray",
    "CudaSmoother",
    "Devices",
    "Distances",
    "Frame",
    "Origin",
    "Sensor",
    "Settings",
    "SettingsFile",
    "Simulated",
    "Smoothed",
    "Smoother",
    "Status",
    "Stream",
    "StreamFrame",
    "__version__",
    "clean",
    "compare",
    "convert",
    "devices",
    "evaluate",
    "info",
    "merge",
    "mesh",
    "prepare",
    "read",
    "read_settings",
    "render",
    "simulate",
    "smooth",
    "stream",
    "write",
    "write_settings",
]
