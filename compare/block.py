#!/usr/bin/env python3
"""Puts standard input into a document: block.py DOCUMENT.md NAME < TEXT.

It replaces what is between the lines <!-- NAME --> and <!-- end of NAME -->.
"""

import os
import pathlib
import sys
import tempfile

document, name = pathlib.Path(sys.argv[1]), sys.argv[2]
start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
text = document.read_text()
if text.count(start) != 1 or text.count(end) != 1 or text.index(start) > text.index(end):
    sys.exit(f"{document}: no block for this text; add the lines\n{start}{end}")
block = sys.stdin.read().strip()
if not block:
    sys.exit(f"{document}: no text for the block {name}; it stays as it was")
with tempfile.NamedTemporaryFile("w", dir=document.resolve().parent, delete=False) as whole:
    whole.write(text[: text.index(start)] + f"{start}\n{block}\n\n" + text[text.index(end) :])
os.chmod(whole.name, document.stat().st_mode)
os.replace(whole.name, document)
