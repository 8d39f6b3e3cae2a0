"""The extension module; the public API is `planish`."""

from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

VERSION: str

_Place = tuple[
    Camera | None, tuple[float, ...] | None, tuple[float, ...] | None, tuple[float, ...] | None
]

class Camera:
    """A pinhole camera with OpenCV's distortion.

    Parameters
    ----------
    width, height : int
        Size of the images in pixels.
    fx, fy : float
        Focal lengths in pixels.
    cx, cy : float, optional
        Principal point in pixels, relative to the centre of the first pixel [default: the centre of the image].
    depth_units_per_metre : float
        Raw depth value of 1 m: 1000 for millimetres.
    distortion : sequence of float, optional
        OpenCV's 4, 5 or 8 coefficients (k1, k2, p1, p2, k3, ...), or the 4 coefficients of a fisheye lens.
    distortion_model : str
        The model's name in ROS, OpenCV or Kalibr; "equidistant" for a fisheye lens [default: OpenCV's model].
    """

    def __new__(
        cls,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float | None = None,
        cy: float | None = None,
        depth_units_per_metre: float = 1000.0,
        distortion: list[float] | None = None,
        distortion_model: str = "",
    ) -> Camera: ...
    @staticmethod
    def kinect_v1() -> Camera:
        """Return the depth camera of a Kinect v1, with the parameters that PCL and ROS assume."""
    @staticmethod
    def read(path: str | PathLike[str], shape: tuple[int, int] | None = None) -> Camera:
        """Read a camera file: ROS camera_info, Kalibr, Open3D, COLMAP or planish's own; `shape` is (height, width)."""
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def depth_units_per_metre(self) -> float: ...
    @property
    def distortion(self) -> list[float]: ...
    @property
    def distortion_model(self) -> str: ...

class CudaArray:
    """A result in CUDA memory, float32 [channels, H, W], for libraries that read DLPack or ``__cuda_array_interface__``."""

    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def __cuda_array_interface__(self) -> dict[str, Any]: ...
    def written_by(self, stream: int) -> None: ...
    def __dlpack_device__(self) -> tuple[int, int]: ...
    def __dlpack__(
        self,
        *,
        stream: int | None = None,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any: ...

class CudaEngine:
    def __new__(cls, settings: dict[str, Any], camera: Camera, is_metres: bool) -> CudaEngine: ...
    def smooth(self, depth: int, row_stride: int, result: int, stream: int) -> None: ...
    def submit(self, depth: int, row_stride: int, stream: int) -> None: ...
    def receive(self, result: int, stream: int) -> bool: ...
    def forget(self) -> None: ...
    def new_result(self, height: int, width: int) -> CudaArray: ...
    def counts(self) -> tuple[int, int, int]: ...
    def gpu_name(self) -> str: ...

class Engine:
    def __new__(cls, settings: dict[str, Any], is_single: bool) -> Engine: ...
    def smooth(
        self, array: NDArray[Any], is_depth: bool, place: _Place, out: dict[str, NDArray[Any]]
    ) -> list[str]: ...
    def restart_video(self) -> None: ...
    def camera_motion(self) -> list[float] | None: ...
    def unused_by_clouds(self) -> list[str]: ...
    def submit(
        self, array: NDArray[Any], is_depth: bool, place: _Place, outputs: dict[str, NDArray[Any]]
    ) -> None: ...
    def receive(self, out: dict[str, NDArray[Any]]) -> bool: ...
    def in_flight(self) -> tuple[int, int]: ...
    def smooth_batch(
        self,
        arrays: list[NDArray[Any]],
        is_depth: bool,
        camera: Camera | None,
        outs: list[dict[str, NDArray[Any]]],
    ) -> list[str]: ...
    def time_library(
        self, array: NDArray[Any], is_depth: bool, place: _Place, outputs: dict[str, NDArray[Any]], runs: int
    ) -> list[float]: ...
    def opened(self) -> tuple[str | None, str | None, str | None]: ...
    def chosen_for_cloud(
        self,
    ) -> tuple[tuple[int, Literal["robust", "off"], int, float | None] | None, tuple[int, int] | None]: ...
    def close(self) -> None: ...

def read(path: str | PathLike[str], unit: str | None, columns: int | None, image: int | None) -> dict[str, Any]: ...
def write_points(
    path: str | PathLike[str],
    points: NDArray[np.float64],
    origin: tuple[float, float, float],
    grid: tuple[int, int] | None,
    fields: dict[str, NDArray[Any]],
    pose: tuple[float, ...] | None,
    encoding: str,
) -> None: ...
def convert(
    input: str | PathLike[str],
    output: str | PathLike[str],
    camera: Camera | None,
    drop_holes: bool,
    fields: list[str] | None,
    encoding: list[str],
) -> tuple[str, str, tuple[int, int], int, list[str]]: ...
def compare_files(a: str | PathLike[str], b: str | PathLike[str], camera: Camera | None, nearest: bool) -> str: ...
def merge(
    inputs: list[str | PathLike[str]],
    output: str | PathLike[str],
    poses: list[tuple[float, ...]] | None,
    encoding: list[str],
) -> tuple[int, list[str]]: ...
def mesh(
    input: str | PathLike[str],
    output: str | PathLike[str],
    camera: Camera | None,
    raw: bool,
    settings: dict[str, Any],
) -> tuple[int, int]: ...

_Cloud = tuple[
    NDArray[np.float64],
    tuple[float, float, float],
    tuple[int, int] | None,
    dict[str, NDArray[Any]],
    tuple[float, ...] | None,
]

def clean(
    cloud: _Cloud,
    crop: list[list[float]] | None,
    voxel: float | None,
    statistical: tuple[int, float] | None,
    radius: tuple[float, int] | None,
) -> dict[str, Any]: ...
def draw(cloud: _Cloud, direction: tuple[float, ...]) -> NDArray[np.uint8]: ...
def prepare(
    depth: NDArray[np.uint16], camera: Camera, settings: dict[str, Any]
) -> tuple[NDArray[np.uint16], Camera]: ...
def write_depth(path: str | PathLike[str], depth: NDArray[Any]) -> None: ...
def simulate(
    scene: str, seed: int, camera: Camera, sensor: str, index: int
) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.float32]]: ...
def read_settings(path: str | PathLike[str]) -> dict[str, Any]: ...
def origin_values() -> bytes: ...
def settings_to_json(settings: dict[str, Any]) -> str: ...
def evaluate(settings: dict[str, Any], seeds: list[int]) -> str: ...
def command(arguments: list[str]) -> int: ...
def devices() -> tuple[list[tuple[int, str, str]], str, str]: ...

class Stream:
    def __new__(
        cls,
        source: str,
        outputs: list[str],
        settings: dict[str, Any],
        camera: Camera | None,
        fps: float | None,
        frames: int | None,
        depth_units_per_metre: float | None,
        align: str | None,
        mode: str | None,
        topic: str | None,
        poses: str | None,
        pose_topic: str | None,
        fixed_frame: str | None,
    ) -> Stream: ...
    def next(self) -> tuple[dict[str, Any] | None, list[str], bool]: ...
    def is_live(self) -> bool: ...
    def statistics(self) -> dict[str, Any] | None: ...
    def close(self) -> None: ...
