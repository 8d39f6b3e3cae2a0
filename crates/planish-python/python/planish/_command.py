"""The command `planish`."""

import sys

from ._planish import command


def main() -> int:
    """Run the command with the arguments of this process."""
    return command(["planish", *sys.argv[1:]])
