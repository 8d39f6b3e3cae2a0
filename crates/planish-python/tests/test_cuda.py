"""Tests of arrays in CUDA memory that need no GPU."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import planish
from planish import _cuda


class OnGpu:
    """A host array that claims to be on CUDA's device 0, like an array of a GPU library."""

    def __init__(self, array: Any, device: int = 2) -> None:
        self.array, self.device = array, device

    def __dlpack_device__(self) -> tuple[int, int]:
        return (self.device, 0)

    def __dlpack__(self, stream: int) -> Any:
        assert stream == 1
        return self.array.__dlpack__()


@pytest.mark.parametrize("kind", ["<u2", "<i2", "<f4"])
def test_dlpack_says_where_an_array_is_and_how_it_lies(kind: str):
    array = np.arange(12 * 20).reshape(12, 20).astype(kind)
    for part in (array, array[2:], array[:, 3:9]):
        found = _cuda._interface(OnGpu(part), "depth", 0)
        truth = part.__array_interface__
        assert (found["shape"], found["typestr"], found["strides"]) == (part.shape, kind, truth["strides"])
        assert found["data"][0] == truth["data"][0]
    with pytest.raises(TypeError, match="DLPack device type 1"):
        _cuda._interface(OnGpu(array, device=1), "depth", 0)
    with pytest.raises(TypeError, match="out: expected an array in CUDA memory .* not list"):
        _cuda._interface([1], "out", 0)


def test_cuda_arrays_are_asked_for_and_a_machine_without_cuda_says_so():
    camera = planish.Camera(64, 48, 50.0, 50.0)
    with pytest.raises(TypeError, match="a planish.Camera"):
        planish.CudaSmoother("kinect")
    with pytest.raises(ValueError, match="outputs"):
        planish.CudaSmoother(camera, outputs=["status"])
    with pytest.raises(ValueError, match="temporal"):
        planish.CudaSmoother(camera, temporal="steady")
    if not Path("/dev/nvidia0").exists():
        with pytest.raises((RuntimeError, ValueError, OSError), match="."):
            planish.CudaSmoother(camera)
