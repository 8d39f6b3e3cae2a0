"""The command `planish`."""

import os
import sys

from ._drivers import find_realsense
from ._planish import command


def main() -> int:
    """Run the command with the arguments of this process."""
    for argument in sys.argv[1:]:
        find_realsense(argument)
    if sys.platform == "linux":
        # Mesa's Vulkan drivers print an error without this variable; the path cannot exist.
        os.environ.setdefault("XDG_RUNTIME_DIR", "/dev/null/none")
    return command(["planish", *sys.argv[1:]])
