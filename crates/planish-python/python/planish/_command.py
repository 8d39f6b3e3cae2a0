"""The command `planish`."""

import sys

from ._drivers import find_realsense
from ._planish import command


def main() -> int:
    """Run the command with the arguments of this process."""
    for argument in sys.argv[1:]:
        find_realsense(argument)
    return command(["planish", *sys.argv[1:]])
