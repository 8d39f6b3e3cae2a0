"""A hook of mkdocs: puts what `planish COMMAND --help` says in the place of `<!-- help COMMAND -->`."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path


def on_page_markdown(markdown: str, **_: object) -> str:
    """Called by mkdocs with the text of every page."""
    beside = Path(sys.executable).with_name("planish")
    program = str(beside) if beside.exists() else shutil.which("planish")

    def help_of(found: re.Match[str]) -> str:
        if program is None:
            raise FileNotFoundError("planish: install crates/planish-python, which brings the command")
        command = [program, *found[1].split(), "--help"]
        said = subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, "COLUMNS": "100"})
        return f"```text\n{said.stdout.rstrip()}\n```"

    return re.sub(r"<!-- help ?(.*?) -->", help_of, markdown)
