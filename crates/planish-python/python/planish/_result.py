"""Smoothing results."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Status(enum.IntEnum):
    """Status of a point in the result."""

    #: A hole: no measurement in the input, no point in the output.
    HOLE = 0
    #: Fewer than 3 neighbours, or an isolated point with ``remove_isolated``: the output is a hole.
    TOO_FEW = 1
    #: The neighbours are collinear: the point is unchanged and has no normal.
    DEGENERATE = 2
    #: On the plane.
    PLANE = 3
    #: On a polynomial of degree 2.
    POLYNOMIAL_2 = 4
    #: On a polynomial of degree 3.
    POLYNOMIAL_3 = 5
    #: In an unorganized cloud, far from all others: the point is unchanged and has no normal.
    ISOLATED = 6
    #: With smoothing over time: this pixel alone jumped, so for one frame it keeps the value of the previous frame.
    CARRIED = 7


class CloudChoice(NamedTuple):
    """How planish smoothed an unorganized cloud, where the settings left that open."""

    #: The approximate number of neighbours per point.
    neighbours: int
    #: Whether edges are kept: ``"robust"``, or ``"off"``.
    edges: Literal["robust", "off"]
    #: 2 if there was a first pass with few neighbours, otherwise 1.
    passes: int
    #: Standard deviation of the points across their surface in metres; ``None`` in a cloud too small for an estimate.
    noise_m: float | None


@dataclass(slots=True, eq=False)
class Smoothed:
    """The result of a frame; outputs that were not requested are ``None``.

    Attributes
    ----------
    points : ndarray of float32, [H, W, 3] or [N, 3]
        Points in metres, NaN for holes; float64 if the input was.
    normals : ndarray of float32, the same shape
        Unit normals towards the sensor, NaN for points without one.
    curvature : ndarray of float32, [H, W] or [N]
        Surface variation l0/(l0+l1+l2), 0 to 1/3; NaN for points without a plane.
    status : ndarray of uint8, [H, W] or [N]
        Status of each point; see `Status`.
    neighbours : ndarray of uint32, [H, W] or [N]
        Number of neighbours, including the point.
    depth : ndarray of uint16, [H, W]
        Raw depth in the camera's units, 0 for holes.
    depth_m : ndarray of float32, [H, W]
        Depth in metres, NaN for holes.
    frames : ndarray of float32, [H, W]
        With ``temporal``: effective number of frames averaged into each point, 1 to 16; 0 for holes.
    """

    points: NDArray[Any] | None = None
    normals: NDArray[np.float32] | None = None
    curvature: NDArray[np.float32] | None = None
    status: NDArray[np.uint8] | None = None
    neighbours: NDArray[np.uint32] | None = None
    depth: NDArray[np.uint16] | None = None
    depth_m: NDArray[np.float32] | None = None
    frames: NDArray[np.float32] | None = None
