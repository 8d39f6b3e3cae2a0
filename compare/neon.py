"""Counts the instructions that the CPU engine executes with NEON, under QEMU; see neon.sh.

usage: neon.py PLUGIN PLANISH FILE ..

A count is half the difference between three repetitions and one, as in instructions.py.
"""

import json
import pathlib
import re
import subprocess
import sys
import tempfile

from instructions import PRESETS

QEMU = ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"]


def executed(plugin, planish, file, arguments, repetitions):
    """Returns the number of instructions of the whole process."""
    with tempfile.TemporaryDirectory() as name:
        log, out = pathlib.Path(name) / "log", pathlib.Path(name) / "out.pcd"
        counting = ["-plugin", plugin, "-d", "plugin", "-D", log]
        options = ["--engine", "cpu", "--threads", "1", "--repeat", str(repetitions), *arguments]
        subprocess.run([*QEMU, *counting, planish, "smooth", file, out, *options], check=True, stdout=subprocess.DEVNULL)
        found = re.search(r"instructions: (\d+)", log.read_text(encoding="utf-8"))
        return int(found[1]) if found else sys.exit(f"{file}: QEMU counted nothing: {log.read_text(encoding='utf-8')!r}")


def main(plugin, planish, *files):
    print("| input | setting | 10⁶ instructions | per pixel or point |\n|---|---|--:|--:|")
    for file in files:
        info = json.loads(subprocess.check_output([*QEMU, planish, "info", "--json", file], encoding="utf-8"))
        settings = [(name, ["--preset", name]) for name in PRESETS] if info["organized"] else [("40 neighbours", ["--neighbours", "40"])]
        for label, arguments in settings:
            one, three = (executed(plugin, planish, file, arguments, repetitions) for repetitions in (1, 3))
            each = (three - one) / 2
            row = [pathlib.Path(file).name, label, f"{each / 1e6:.1f}", f"{each / (info['width'] * info['height']):.0f}"]
            print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
