"""Frames that never leave the GPU: depth and results in the memory of PyTorch, CuPy or JAX."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import math
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._planish import Camera, CudaArray, CudaEngine
from ._settings import Output, Settings

if TYPE_CHECKING:
    from typing_extensions import Unpack

# Number of channels of each output, in the order of a result.
CHANNELS = {"points": 3, "normals": 3, "curvature": 1, "depth_m": 1}


class CudaSmoother:
    """Smooths depth images that are CUDA arrays, into CUDA arrays, without a copy to the host.

    Needs NVIDIA's driver and NVRTC, CUDA's compiler, which PyTorch includes (otherwise ``pip install nvidia-cuda-nvrtc-cu12``).
    Accepts arrays of PyTorch, CuPy, JAX and Numba (any array with ``__cuda_array_interface__`` or ``__dlpack__``). For
    arrays of PyTorch and CuPy, calls return at once, and the work runs on the library's current stream. For others, it runs on the
    stream that writes the array, if the array names one, otherwise on the default stream. `smooth_batch` smooths up to 16 images at once, in less time per image.

    Parameters
    ----------
    camera : Camera
        Camera of the images, without distortion.
    metres : bool
        Whether depth is float32 in metres; otherwise uint16 (or int16 of the same bits) in the camera's units.
    outputs : iterable of str
        Any of ``"points"``, ``"normals"``, ``"curvature"`` and ``"depth_m"``.
    **settings : Settings
        See `Smoother`. ``adapter`` is the index of a CUDA device or part of its name [default: the current device].
        Steps before smoothing, ``fill``, ``temporal`` and ``sensor="auto"`` are not supported for CUDA arrays.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        metres: bool = False,
        outputs: Iterable[Output] = ("points",),
        **settings: Unpack[Settings],
    ) -> None:
        if not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a planish.Camera, not {type(camera).__name__}")
        names = list(outputs) if not isinstance(outputs, str) else [outputs]
        unknown = [name for name in names if name not in CHANNELS]
        if unknown or not names:
            raise ValueError(f"outputs: expected some of {', '.join(CHANNELS)}, not {', '.join(unknown) or 'none'}")
        self._camera = camera
        self._metres = metres
        given = {name: value for name, value in settings.items() if value is not None}
        _load_compiler()
        self._engine = CudaEngine({"engine": "gpu", **given, "outputs": names}, camera, metres)
        self._channels, _, self._most = self._engine.counts()
        # The arrays of the last call, kept alive until the next one, because the libraries' allocators do not wait for
        # every stream before they reuse freed memory.
        self._last: tuple[list[Any], list[Any]] = ([], [])

    @property
    def channels(self) -> int:
        """Number of planes of a result: x, y and z of points, then of normals, then curvature and depth in metres."""
        return self._channels

    @property
    def gpu(self) -> str:
        """The name of the GPU."""
        return self._engine.gpu_name()

    def smooth(self, depth: Any, *, out: Any = None, stream: int | None = None) -> Any:
        """Smooth one image.

        Parameters
        ----------
        depth : CUDA array, [H, W]
            The image; rows may have gaps.
        out : CUDA array, float32 [channels, H, W], optional
            Array to write the result into. By default, this is a new PyTorch or CuPy array if `depth` belongs to one of
            these libraries, otherwise a `CudaArray`, which other libraries read through DLPack
            (``jax.dlpack.from_dlpack``).
        stream : int, optional
            The CUDA stream, as the address of a ``cudaStream_t`` [default: the current stream of the library of `depth`]. If you pass
            another stream, keep arrays of libraries other than PyTorch alive until the stream has used them.

        Returns
        -------
        CUDA array, float32 [channels, H, W]
            The result; holes are NaN.
        """
        interface = _interface(depth, "depth", stream)
        chosen = _stream_of(depth, interface) if stream is None else stream
        image = self._input(interface)
        target = self._new(depth, stream) if out is None else out
        kept, address = self._output(target, chosen)
        self._engine.smooth(*image, address, chosen)
        self._done([depth], [target], stream, chosen, [interface, kept])
        return target

    def smooth_batch(
        self, depths: Sequence[Any], *, outs: Sequence[Any] | None = None, stream: int | None = None
    ) -> list[Any]:
        """Smooth several images, up to 16 at a time; see `smooth`."""
        if outs is not None and len(outs) != len(depths):
            raise ValueError(f"outs: expected one array per image ({len(depths)}), not {len(outs)}")
        results: list[Any] = []
        for begin in range(0, len(depths), self._most):
            group = list(depths[begin : begin + self._most])
            interfaces = [_interface(depth, "depth", stream) for depth in group]
            chosen = _stream_of(group[0], interfaces[0]) if stream is None else stream
            inputs = [self._input(interface) for interface in interfaces]
            given = [None] * len(group) if outs is None else list(outs[begin : begin + self._most])
            targets = [self._new(depth, stream) if out is None else out for depth, out in zip(group, given)]
            outputs = [self._output(out, chosen) for out in targets]
            try:
                for address, stride in inputs:
                    self._engine.submit(address, stride, chosen)
                for _, address in outputs:
                    self._engine.receive(address, chosen)
            except BaseException:
                # The next call must not receive the remaining results of this one.
                self._engine.forget()
                raise
            self._done(group, targets, stream, chosen, [interfaces, outputs])
            results.extend(targets)
        return results

    def _done(self, depths: list[Any], targets: list[Any], given: int | None, chosen: int, kept: list[Any]) -> None:
        """Keep the arrays until the next call, and inform the owners of the memory that the stream uses it."""
        self._last = ([*depths, *kept], targets)
        for target in targets:
            if isinstance(target, CudaArray):
                target.written_by(chosen)
        for array in [*depths, *targets] if given is not None else []:
            if _library(array) == "torch":
                torch = sys.modules["torch"]
                array.record_stream(torch.cuda.ExternalStream(given, device=array.device))

    def _input(self, interface: dict[str, Any]) -> tuple[int, int]:
        """Return the address of an image, and the distance between its rows in bytes."""
        types = ("<f4",) if self._metres else ("<u2", "<i2")
        shape, kind = tuple(interface["shape"]), interface["typestr"]
        expected = (self._camera.height, self._camera.width)
        if shape != expected or kind not in types:
            raise ValueError(f"depth: expected {' or '.join(types)} of shape {expected}, not {kind} of {shape}")
        item = int(kind[2:])
        strides = interface.get("strides") or (item * shape[1], item)
        # The stride of an axis of length 1 is arbitrary.
        between_rows = strides[0] if shape[0] > 1 else item * shape[1]
        if (shape[1] > 1 and strides[1] != item) or between_rows < item * shape[1]:
            raise ValueError(f"depth: pixels of a row must be adjacent; its strides are {tuple(strides)} bytes")
        return int(interface["data"][0]), int(between_rows)

    def _output(self, out: Any, stream: int) -> tuple[dict[str, Any], int]:
        """Return the interface of an array for a result, which must be kept alive, and its address."""
        interface = _interface(out, "out", stream)
        shape = (self._channels, self._camera.height, self._camera.width)
        strides = interface.get("strides")
        is_contiguous = strides is None or tuple(strides) == _contiguous(shape, 4)
        if tuple(interface["shape"]) != shape or interface["typestr"] != "<f4" or not is_contiguous:
            found = f"{interface['typestr']} of {tuple(interface['shape'])}"
            raise ValueError(f"out: expected contiguous <f4 of shape {shape}, not {found}")
        if interface["data"][1]:
            raise ValueError("out: the array is read-only")
        return interface, int(interface["data"][0])

    def _new(self, depth: Any, stream: int | None) -> Any:
        """Return a new array of the same library as an image, allocated for the stream that writes it."""
        shape = (self._channels, self._camera.height, self._camera.width)
        library = _library(depth)
        if library == "torch":
            torch = sys.modules["torch"]
            chosen = None if stream is None else torch.cuda.ExternalStream(stream, device=depth.device)
            with torch.cuda.stream(chosen):
                return torch.empty(shape, dtype=torch.float32, device=depth.device)
        if library == "cupy":
            cupy = sys.modules["cupy"]
            with depth.device, contextlib.nullcontext() if stream is None else cupy.cuda.ExternalStream(stream):
                return cupy.empty(shape, dtype="float32")
        return self._engine.new_result(self._camera.height, self._camera.width)


def _library(array: Any) -> str:
    return type(array).__module__.partition(".")[0]


def _contiguous(shape: tuple[int, ...], item: int) -> tuple[int, ...]:
    """Return the strides in bytes of an array without gaps."""
    return tuple(item * math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


def _load_compiler() -> None:
    """Load NVRTC from NVIDIA's packages, so that the engine finds it among the loaded libraries."""
    nvidia = importlib.util.find_spec("nvidia")
    folders = [Path(folder) for folder in (nvidia.submodule_search_locations or [])] if nvidia else []
    for pattern in ("*/lib/libnvrtc.so.*", "*/bin/nvrtc64_*_0.dll", "*/bin/*/nvrtc64_*_0.dll"):
        for file in (file for folder in folders for file in folder.glob(pattern)):
            if sys.platform == "win32":
                # NVRTC loads another library from its folder.
                os.add_dll_directory(str(file.parent))
            # A library for another architecture fails to load, but another one may work.
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(file))


def _interface(array: Any, name: str, stream: int | None) -> dict[str, Any]:
    """Return shape, type, strides in bytes and address of an array, in the form of ``__cuda_array_interface__``."""
    has_dlpack = hasattr(array, "__dlpack__") and not isinstance(array, CudaArray)
    # Only DLPack orders the stream after the work that writes JAX's arrays.
    if has_dlpack and (_library(array) not in ("torch", "cupy") or not hasattr(array, "__cuda_array_interface__")):
        return _of_dlpack(array, name, stream)
    try:
        interface: dict[str, Any] | None = getattr(array, "__cuda_array_interface__", None)
    except (AttributeError, TypeError):
        interface = None
    if interface is None:
        found = type(array).__name__
        raise TypeError(f"{name}: expected an array in CUDA memory (PyTorch, CuPy, JAX, Numba), not {found}")
    return interface


class _DlTensor(ctypes.Structure):
    """DLPack's tensor: the beginning of a ``DLManagedTensor``."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("device_type", ctypes.c_int32),
        ("device_id", ctypes.c_int32),
        ("dimensions", ctypes.c_int32),
        ("code", ctypes.c_uint8),
        ("bits", ctypes.c_uint8),
        ("lanes", ctypes.c_uint16),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
        ("strides", ctypes.POINTER(ctypes.c_int64)),
        ("byte_offset", ctypes.c_uint64),
    )


_pointer_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(("PyCapsule_GetPointer", ctypes.pythonapi))

# DLPack's device types for CUDA memory and CUDA managed memory.
_CUDA_DEVICES = (2, 13)
_KINDS = {0: "i", 1: "u", 2: "f"}


def _of_dlpack(array: Any, name: str, stream: int | None) -> dict[str, Any]:
    device, _ = array.__dlpack_device__()
    if int(device) not in _CUDA_DEVICES:
        raise TypeError(f"{name}: expected an array in CUDA memory, not one of DLPack device type {int(device)}")
    # 1 is the default stream. The capsule frees its tensor when it is deleted, since no other library takes ownership.
    capsule = array.__dlpack__(stream=stream or 1)
    tensor = _DlTensor.from_address(_pointer_of(capsule, b"dltensor"))
    item = tensor.bits // 8
    shape = tuple(tensor.shape[: tensor.dimensions])
    strides = tuple(item * stride for stride in tensor.strides[: tensor.dimensions]) if tensor.strides else None
    return {
        "shape": shape,
        "typestr": f"<{_KINDS.get(tensor.code, '?')}{item}",
        "strides": None if strides == _contiguous(shape, item) else strides,
        "data": ((tensor.data or 0) + tensor.byte_offset, False),
        "capsule": capsule,
    }


def _stream_of(array: Any, interface: dict[str, Any]) -> int:
    """Return the current stream of the array's library, otherwise the stream that writes the array, otherwise the default stream."""
    library = _library(array)
    if library == "torch":
        return int(sys.modules["torch"].cuda.current_stream(array.device).cuda_stream)
    if library == "cupy":
        return int(sys.modules["cupy"].cuda.get_current_stream().ptr)
    return int(interface.get("stream") or 0)
