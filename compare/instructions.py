"""Counts the instructions that the CPU engine executes for a frame or cloud.

usage: instructions.py PLANISH FILE ..                     prints tables of all presets, and of the stages
       instructions.py PLANISH --check COUNTS.json         fails if a simulated input's count is off by over 3 %
       instructions.py PLANISH --update COUNTS.json        writes that file

Counts are measured by callgrind, which supports AVX2 but not AVX-512, with one thread. A count is half the difference between three
repetitions and one, so reading, writing, starting up and the choice of a cloud's neighbours do not count. Unlike times, counts do not
depend on the load, or on the machine if it has AVX2.
"""

import collections
import json
import math
import pathlib
import platform
import re
import struct
import subprocess
import sys
import tempfile
import zlib

TOLERANCE = 0.03
# Tolerance if the file was written with another compiler.
WIDE_TOLERANCE = 0.15
PRESETS = ("light", "default", "strong", "paper")
# The function that starts the kernel of each stage, as a regular expression.
STAGES = {
    "block means": r"Run::average::",
    "planes and vote": r"Run::find_surfaces::",
    "last fit": r"Run::fit::",
    "pixels": r"Cpu::smooth_rows::",
    "radius": r"general::radius::solve$",
    "cloud": r"general::(?!radius)",
}


def profile(planish, file, arguments, repetitions, folder):
    """Starts callgrind. Returns the process and the file that it writes."""
    out = folder / f"{repetitions}.callgrind"
    command = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}", planish, "smooth", file, folder / f"{repetitions}.pcd"]
    options = ["--engine", "cpu", "--threads", "1", "--repeat", str(repetitions), *arguments]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"), out


def read(out):
    """Returns the number of all instructions, and those of each stage including its callees."""
    names, stages = {}, collections.Counter()
    total, caller, callee, is_call = 0, "", "", False
    for line in out.open(encoding="utf-8", errors="replace"):
        if name := re.match(r"(c?)fn=\((\d+)\)(?: (.*))?", line.rstrip()):
            if name[3]:
                names[name[2]] = name[3]
            if name[1]:
                callee = names[name[2]]
            else:
                caller = names[name[2]]
        elif line.startswith("calls="):
            is_call = True
        elif line.startswith("totals:"):
            total = int(line.split()[1])
        elif is_call and line[0] in "0123456789+-*":
            is_call = False
            for stage, function in STAGES.items():
                if "vectorize" in callee and re.search(function, caller):
                    stages[stage] += int(line.split()[1])
    return total, stages


def count(planish, file, arguments):
    """Returns the number of instructions of one repetition, in total and by stage."""
    with tempfile.TemporaryDirectory() as name:
        runs = [profile(planish, file, arguments, repetitions, pathlib.Path(name)) for repetitions in (1, 3)]
        results = []
        for process, out in runs:
            text, _ = process.communicate()
            if process.returncode != 0:
                for other, _ in runs:
                    other.kill()
                sys.exit(f"{' '.join(map(str, process.args))} failed:\n{text}")
            results.append(read(out))
    (one, stages_of_one), (three, stages_of_three) = results
    if not three > one > 0 or not stages_of_three:
        sys.exit(f"{file}: callgrind counted {one} and {three} instructions, of stages {dict(stages_of_three)}; see STAGES")
    return (three - one) / 2, {stage: (stages_of_three[stage] - stages_of_one[stage]) / 2 for stage in STAGES}


def tables(planish, files):
    columns = list(STAGES)
    print("| input | setting | 10⁶ instructions | per pixel or point |", *(f" {stage} |" for stage in columns), " rest |", sep="")
    print("|---|---|" + "--:|" * (len(columns) + 3))
    for file in files:
        info = json.loads(subprocess.check_output([planish, "info", "--json", file], encoding="utf-8"))
        settings = [(name, ["--preset", name]) for name in PRESETS] if info["organized"] else [("40 neighbours", ["--neighbours", "40"])]
        for label, arguments in settings:
            total, stages = count(planish, file, arguments)
            cells = [f"{stages[stage] / 1e6:.1f}" if stages[stage] else "" for stage in columns]
            rest = (total - sum(stages.values())) / 1e6
            row = [pathlib.Path(file).name, label, f"{total / 1e6:.1f}", f"{total / (info['width'] * info['height']):.0f}", *cells, f"{rest:.1f}"]
            print("| " + " | ".join(row) + " |", flush=True)


def depth_frame():
    """Returns a PNG of 320x240 depths in mm: a slanted wall, with a noisy ball and a noisy box in front of it."""
    seed, rows = 1, []
    for v in range(240):
        row = [0]
        for u in range(320):
            seed = (1103515245 * seed + 12345) % 2**31
            depth = 2000 + u + 2 * v
            if (u - 90) ** 2 + (v - 100) ** 2 < 3600:
                depth = 1200 - math.isqrt(3600 - (u - 90) ** 2 - (v - 100) ** 2)
            elif 180 < u < 270 and 60 < v < 190:
                depth = 1500 + abs(u - 225)
            depth += seed % 2**16 * depth**2 // 2**16 // 500_000
            row += divmod(depth, 256)
        rows.append(bytes(row))
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    header = struct.pack(">IIBBBBB", 320, 240, 16, 0, 0, 0, 0)
    data = zlib.compress(b"".join(rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def simulated(planish, folder):
    """Returns inputs and arguments by name: a simulated frame, and a cloud of its points, one per voxel."""
    frame, cloud = folder / "frame.png", folder / "cloud.ply"
    frame.write_bytes(depth_frame())
    camera = ["--camera", "262.5,262.5,159.5,119.5"]
    subprocess.run([planish, "clean", frame, cloud, *camera, "--voxel", "0.05"], check=True, stdout=subprocess.DEVNULL)
    return {
        "default": (frame, camera),
        "paper": (frame, [*camera, "--preset", "paper"]),
        "cloud": (cloud, ["--neighbours", "40"]),
    }


def check(planish, file, update):
    if platform.machine() != "x86_64" or " avx2 " not in pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8"):
        sys.exit("counts are compared on x86-64 with AVX2 only")
    compiler = subprocess.check_output(["rustc", "--version"], encoding="utf-8").strip()
    with tempfile.TemporaryDirectory() as name:
        inputs = simulated(planish, pathlib.Path(name))
        counts = {name: round(count(planish, *arguments)[0]) for name, arguments in inputs.items()}
    if update:
        file.write_text(json.dumps({"compiler": compiler, "counts": counts}, indent=2) + "\n", encoding="utf-8")
        return
    known = json.loads(file.read_text(encoding="utf-8"))
    ratios = {name: found / known["counts"][name] for name, found in counts.items()}
    for name, ratio in ratios.items():
        print(f"{name}: {counts[name] / 1e6:.1f} million instructions, {ratio:.3f} of {file.name}")
    tolerance = TOLERANCE if known["compiler"] == compiler else WIDE_TOLERANCE
    if tolerance != TOLERANCE:
        print(f"{file.name} was written with {known['compiler']}, and this is {compiler}: up to {tolerance:.0%} are allowed")
    if changed := [name for name, ratio in ratios.items() if abs(ratio - 1) > tolerance]:
        sys.exit(f"over {tolerance:.0%} more or fewer instructions: {', '.join(changed)}; if that is intended, run with --update {file}")


def main():
    match sys.argv[1:]:
        case [planish, "--check" | "--update" as option, file]:
            check(planish, pathlib.Path(file), option == "--update")
        case [planish, first, *files] if not first.startswith("-"):
            tables(planish, [first, *files])
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
