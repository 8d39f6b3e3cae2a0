"""Smoothing results."""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._planish import origin_values as _origin_values


class Status(enum.IntEnum):
    """Status of a point in the result."""

    #: A hole: no measurement in the input, no point in the output.
    HOLE = 0
    #: Fewer than 3 neighbours, or an isolated point with ``remove_isolated``: the output is a hole.
    TOO_FEW = 1
    #: The neighbours are collinear: the point is unchanged, without a normal.
    DEGENERATE = 2
    #: Moved onto a fitted plane.
    PLANE = 3
    #: Moved onto a polynomial of degree 2.
    POLYNOMIAL_2 = 4
    #: Moved onto a polynomial of degree 3.
    POLYNOMIAL_3 = 5
    #: In an unorganized cloud, far from all others: the point is unchanged, without a normal.
    ISOLATED = 6
    #: With smoothing over time: this pixel alone jumped, so for one frame it keeps the value of the previous frame.
    CARRIED = 7
    #: With ``fill``: a hole that was filled with the surface around it. Nothing was measured here.
    FILLED = 8


class Origin(enum.IntEnum):
    """Origin of a point's value, as in the masks next to depth images (NAME.origin.png)."""

    #: No value.
    NONE = 0
    #: Filled with the surface around the hole.
    FILLED = 85
    #: Kept from the previous frame of a video.
    CARRIED = 170
    #: Measured in this frame.
    MEASURED = 255


class CloudChoice(NamedTuple):
    """The choices that planish made for an unorganized cloud because the settings left them open."""

    #: The approximate number of neighbours per point.
    neighbours: int
    #: Whether edges are kept: ``"robust"``, or ``"off"``.
    edges: Literal["robust", "off"]
    #: 2 if there was a first pass with few neighbours, otherwise 1.
    passes: int
    #: Standard deviation of the points across their surface in metres; ``None`` in a cloud too small for an estimate.
    noise_m: float | None


def _is_empty(value: Any) -> bool:
    return isinstance(value, dict) and not value


def described(of: Any) -> str:
    """Describe an object in one line by its attributes that are not ``None``; arrays are shown by type and shape."""

    def text(value: Any) -> str:
        if isinstance(value, np.ndarray):
            return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
        if isinstance(value, dict):
            return "{" + ", ".join(f"{key}: {text(item)}" for key, item in value.items()) + "}"
        return repr(value)

    values = ((field.name, getattr(of, field.name)) for field in dataclasses.fields(of))
    given = [f"{name}={text(value)}" for name, value in values if value is not None and not _is_empty(value)]
    return f"{type(of).__name__}({', '.join(given)})"


# Value of outputs that were not requested. Typed as Any, so that requested outputs need no check for None.
_ABSENT: Any = None


@dataclass(slots=True, eq=False, repr=False)
class Smoothed:
    """The result of a frame. Outputs that were not requested are ``None``, but are typed as arrays for type checkers.

    Attributes
    ----------
    points : ndarray of float32, [H, W, 3] or [N, 3]
        Points in metres, NaN for holes; float64 if the input was float64.
    normals : ndarray of float32, [H, W, 3] or [N, 3]
        Unit normals towards the sensor, NaN for points without one.
    curvature : ndarray of float32, [H, W] or [N]
        Surface variation l0/(l0+l1+l2), 0 to 1/3; NaN for points without a plane.
    status : ndarray of uint8, [H, W] or [N]
        Status of each point; see `Status`.
    neighbours : ndarray of uint32, [H, W] or [N]
        Number of neighbours, including the point itself.
    depth : ndarray of uint16, [H, W]
        Raw depth in the camera's units, 0 for holes.
    depth_m : ndarray of float32, [H, W]
        Depth in metres, NaN for holes.
    frames : ndarray of float32, [H, W]
        With ``temporal``: effective number of frames averaged into each point, 1 to 16; 0 for holes.
    sigma : ndarray of float32, [H, W]
        For frames on a grid: standard error of each point along its ray in metres; NaN for holes.
    """

    points: NDArray[Any] = _ABSENT
    normals: NDArray[np.float32] = _ABSENT
    curvature: NDArray[np.float32] = _ABSENT
    status: NDArray[np.uint8] = _ABSENT
    neighbours: NDArray[np.uint32] = _ABSENT
    depth: NDArray[np.uint16] = _ABSENT
    depth_m: NDArray[np.float32] = _ABSENT
    frames: NDArray[np.float32] = _ABSENT
    sigma: NDArray[np.float32] = _ABSENT

    @property
    def origin(self) -> NDArray[np.uint8]:
        """Origin of each value, in the shape of `status`; see `Origin`. Needs the output ``"status"``.

        Examples
        --------
        >>> import planish
        >>> frame = planish.simulate("table")
        >>> frame.depth[200:204, 300:304] = 0
        >>> result = planish.smooth(frame.depth, frame.camera, fill=8)
        >>> bool((result.origin[200:204, 300:304] == planish.Origin.FILLED).all())
        True
        """
        if self.status is None:
            raise ValueError('origin: needs the status; add "status" to the outputs')
        return np.frombuffer(_origin_values(), np.uint8)[self.status]

    def __repr__(self) -> str:
        return described(self)
