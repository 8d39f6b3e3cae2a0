"""A callable for data pipelines: for actors of Ray or Daft, or any process pool."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._planish import Camera
from ._smoothing import Smoother


class SmoothFrames:
    """Smooths a column of depth images batch by batch.

    Designed for actors with one thread each. Each actor opens its own `Smoother` in its process. A frame that cannot be smoothed is not
    fatal: its row gets an image of holes and the error message.

    Parameters
    ----------
    camera : Camera
        Camera of all frames.
    column : str
        Name of the column of depth images, uint16 [H, W] each.
    output : {"depth", "points"}
        The result: uint16 depth (0.6 MB for 640x480), or float32 points (3.7 MB).
    result_column, error_column : str
        Names of the added columns.
    threads : int
        Number of threads of the CPU engine [default: 1, for one actor per core].
    **settings
        See `planish.Settings`. With ``engine="gpu"`` and no ``adapter``, the first GPU visible to the actor is used.

    Examples
    --------
    >>> import numpy as np, planish
    >>> from planish.data import SmoothFrames
    >>> frame = planish.simulate("table")
    >>> smooth = SmoothFrames(frame.camera)
    >>> batch = smooth({"depth": np.stack([frame.depth, frame.depth])})
    >>> batch["smoothed"].shape, list(batch["error"])
    ((2, 480, 640), ['', ''])
    """

    def __init__(
        self,
        camera: Camera,
        *,
        column: str = "depth",
        output: str = "depth",
        result_column: str = "smoothed",
        error_column: str = "error",
        threads: int = 1,
        **settings: Any,
    ) -> None:
        if output not in ("depth", "points"):
            raise ValueError(f'output = {output!r} is not allowed; expected "depth" or "points"')
        self._columns = (column, result_column, error_column)
        self._output = output
        if settings.get("engine") == "gpu" and "adapter" not in settings and os.environ.get("CUDA_VISIBLE_DEVICES"):
            # Vulkan ignores CUDA's variable, so pass the physical device number.
            first = os.environ["CUDA_VISIBLE_DEVICES"].split(",")[0]
            if first.isdigit():
                settings["adapter"] = first
        self._smoother = Smoother(camera, outputs=[output], threads=threads, **settings)  # type: ignore[list-item]

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Smooth a batch of named columns, one of which contains the depth images."""
        column, result_column, error_column = self._columns
        if column not in batch:
            raise KeyError(f"the batch has no column {column!r}; its columns are {', '.join(batch)}")
        results: list[NDArray[Any]] = []
        errors: list[str] = []
        for frame in batch[column]:
            try:
                smoothed = self._smoother.smooth(np.asarray(frame))
                results.append(getattr(smoothed, self._output))
                errors.append("")
            except (TypeError, ValueError) as error:
                results.append(self._holes())
                errors.append(str(error) or type(error).__name__)
        result = np.stack(results) if results else np.empty((0, 0, 0), np.uint16)
        return {**batch, result_column: result, error_column: np.array(errors, dtype=object)}

    def _holes(self) -> NDArray[Any]:
        camera = self._smoother.camera
        assert camera is not None
        shape = (camera.height, camera.width)
        return np.zeros(shape, np.uint16) if self._output == "depth" else np.full((*shape, 3), np.nan, np.float32)
