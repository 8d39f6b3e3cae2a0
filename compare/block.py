#!/usr/bin/env python3
"""Runs a command and inserts its output into a document: block.py DOCUMENT.md COMMAND [ARGUMENT ..].

Replaces the text between the lines <!-- COMMAND --> and <!-- end of COMMAND -->. If the command fails, the document
is unchanged.
"""

import os
import pathlib
import subprocess
import sys
import tempfile

document, command = pathlib.Path(sys.argv[1]), sys.argv[2:]
start, end = f"<!-- {command[0]} -->\n", f"<!-- end of {command[0]} -->"


def around():
    text = document.read_text(encoding="utf-8")
    if text.count(start) != 1 or text.count(end) != 1 or text.index(start) > text.index(end):
        sys.exit(f"{document}: expected these lines exactly once and in this order; add them:\n{start}{end}")
    return text[: text.index(start)] + start, text[text.index(end) :]


around()
run = subprocess.run(command, stdout=subprocess.PIPE, encoding="utf-8")
print(run.stdout, end="")
if run.returncode != 0 or not run.stdout.strip():
    sys.exit(f"{document}: {command[0]} failed; the block is unchanged")
before, after = around()
handle, name = tempfile.mkstemp(dir=document.resolve().parent)
try:
    with open(handle, "w", encoding="utf-8") as whole:
        whole.write(f"{before}\n{run.stdout.strip()}\n\n{after}")
    os.chmod(name, document.stat().st_mode)
    os.replace(name, document)
except BaseException:
    os.unlink(name)
    raise
