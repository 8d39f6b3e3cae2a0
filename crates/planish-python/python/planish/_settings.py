"""Settings, which have the same names, ranges and files in the command, Python, ROS and the browser."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypedDict, cast

from ._planish import read_settings as _read_settings
from ._planish import settings_to_json as _settings_to_json

Output = Literal["points", "normals", "curvature", "status", "neighbours", "depth", "depth_m", "frames", "sigma"]
Preset = Literal["light", "default", "strong", "paper"]
SensorName = Literal["kinect1", "d415", "d435", "d455", "azure-kinect", "l515", "iphone", "exact", "auto"]


class Sensor(TypedDict, total=False):
    """An unnamed sensor: depth step and noise in metres, as coefficients of 1, z and z²."""

    step: list[float]
    sigma: list[float]


class Settings(TypedDict, total=False):
    """The keyword arguments of `smooth`, `Smoother` and `stream`, and the contents of settings files.

    Omitted fields take the value of the preset.

    Examples
    --------
    >>> import planish
    >>> settings: planish.Settings = {"preset": "strong", "edges": "off"}
    >>> frame = planish.simulate("table")
    >>> result = planish.smooth(frame.depth, frame.camera, **settings)
    """

    preset: Preset | None
    """Preset: windows of 15x15 (light), 25x25 (default) or 29x29 (strong) pixels for a Kinect v1, wider for noisier sensors; "paper" selects the
    settings of the 2011 report."""
    strength: float | None
    """Strength from 0 (light) to 1 (strong), instead of a preset."""
    sensor: SensorName | Sensor | None
    """The sensor that took the frames [default: kinect1]; "auto" estimates it from the first frame. Unorganized clouds need a named sensor, and must be in
    its frame or state its pose [default: none, or kinect1 if its depth steps are recognized]."""
    radius_m: float | Literal["sensor"] | None
    """Radius of a neighbourhood in metres; "sensor" selects a radius that grows with range like the sensor's noise. For unorganized clouds, name the sensor too."""
    radius: float | Literal["sensor"] | None
    """Another name for radius_m."""
    neighbours: int | None
    """For unorganized clouds: number of neighbours, 6 to 1000, instead of a radius [default: chosen by the cloud's
    noise and shape]."""
    passes: Literal[1, 2] | None
    """For unorganized clouds: number of passes; 2 adds a first pass with 20 neighbours [default: chosen from the noise; 1 with a given radius or
    number of neighbours]."""
    grid: Literal["auto", "off"] | None
    """For unorganized clouds: whether the grid of a frame is rebuilt if it was lost [default: auto]."""
    even: bool | None
    """For unorganized clouds: whether points move along the smoothed surface until they are spaced evenly, by at most
    1.5 standard deviations of the noise [default: false]. Not for streams."""
    temporal: Literal["off", "steady"] | None
    """For consecutive frames of one camera: ``"steady"`` smooths over time [default: off]. A `Smoother` keeps the state and restarts if the shape
    of frames changes. The camera is assumed stationary unless ``track`` or poses are given."""
    track: bool | None
    """Whether to smooth over time with compensation of the camera's motion, estimated from frame to frame [default: false]."""
    edges: Literal["robust", "off"] | None
    """Edge handling [default: robust for frames and for clouds of a known sensor; chosen by the shape of other unorganized clouds,
    off with a given radius or number of neighbours]."""
    window: int | None
    """Half-width of the window in samples, 1 to 7; without window and stride, both adapt to the frame's resolution."""
    stride: int | None
    """Distance between samples in pixels, 1 to 8."""
    average_blocks: bool | None
    """Whether each sample is the mean of its block of pixels."""
    degree: int | None
    """Degree of the surface, 1 to 3."""
    bandwidth_m: float | None
    """Bandwidth of the Gaussian weights in metres [default: the radius]."""
    bandwidth: float | None
    """Another name for bandwidth_m."""
    ridge: float | None
    """Damping of slopes and curvatures, 1e-3 (weak) to 100 (a plane)."""
    project: Literal["ray", "normal"] | None
    """Direction in which points move onto the surface; frames only."""
    remove_floating: bool | None
    """Whether pixels that float between two surfaces become holes before smoothing. Streams, `mesh` and the command only."""
    min_range_m: float | None
    """Minimum range in metres; nearer pixels of a frame become holes before smoothing. Streams, `mesh` and the command only."""
    max_range_m: float | None
    """Maximum range in metres; farther pixels of a frame become holes before smoothing. Streams, `mesh` and the command only."""
    decimate: int | None
    """Side of the blocks of pixels that are merged into one before smoothing, 2 to 8. Streams, `mesh` and the command only."""
    fill: int | None
    """Fills holes of a frame up to this width in pixels, 1 to 64, with the surface around them [default: none]. Filled
    points have the status `Status.FILLED`; the outputs must include ``"status"``."""
    remove_isolated: bool | None
    """Whether isolated points of unorganized clouds become holes [default: False]."""
    engine: Literal["auto", "cpu", "gpu", "reference"] | None
    """The engine [default: auto, a real GPU if available, otherwise the CPU]. `planish.smooth` uses the CPU unless the frame is large."""
    adapter: str | int | None
    """The GPU by index or part of its name; needs engine="gpu"."""
    devices: str | None
    """Devices that share the frames of a stream, separated by commas: "all", or indices or names of GPUs, and "cpu"."""
    threads: int | None
    """Number of threads of the CPU engine [default: one per core]."""


class SettingsFile(Settings, total=False):
    """The contents of a settings file, which may also list outputs."""

    outputs: list[Output]


def read_settings(path: str | PathLike[str]) -> SettingsFile:
    """Read a settings file in JSON or YAML, the format of the command's ``--settings`` and of the demo page.

    Examples
    --------
    >>> import pathlib, tempfile, planish
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "wall.yaml"
    >>> _ = file.write_text("preset: strong\\nedges: off\\n")
    >>> planish.read_settings(file)
    {'preset': 'strong', 'edges': 'off'}
    """
    return cast(SettingsFile, _read_settings(os.fspath(path)))


def write_settings(path: str | PathLike[str], settings: Mapping[str, Any]) -> None:
    """Check settings as `Smoother` does, and write them to a JSON file."""
    text = _settings_to_json(dict(settings))
    Path(path).write_text(json.dumps(json.loads(text), indent=2) + "\n", encoding="utf-8")
