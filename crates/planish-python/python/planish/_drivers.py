"""Camera drivers from Python packages."""

import importlib.util
import os
from pathlib import Path


def find_realsense(source: str) -> None:
    """Let the source ``realsense`` use the library of the package pyrealsense2, if it is installed and the environment names no other."""
    if source.split(":")[0] != "realsense" or os.environ.get("PLANISH_LIBREALSENSE"):
        return
    package = importlib.util.find_spec("pyrealsense2")
    for folder in package.submodule_search_locations or [] if package else []:
        # The extension module contains all of librealsense, and exports its C functions on Linux.
        for library in sorted(Path(folder).glob("pyrealsense2.*.so")):
            os.environ["PLANISH_LIBREALSENSE"] = str(library)
