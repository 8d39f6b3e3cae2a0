"""Camera drivers from Python packages."""

import importlib.util
import os
from pathlib import Path


def find_realsense(source: str) -> None:
    """Let the source ``realsense`` use the library of the package pyrealsense2, if it is installed and no other is named."""
    if source.split(":")[0] != "realsense" or os.environ.get("PLANISH_LIBREALSENSE"):
        return
    package = importlib.util.find_spec("pyrealsense2")
    for folder in package.submodule_search_locations or [] if package else []:
        # The whole of librealsense is in the extension module, and on Linux its C functions can be called.
        for library in sorted(Path(folder).glob("pyrealsense2.*.so")):
            os.environ["PLANISH_LIBREALSENSE"] = str(library)
