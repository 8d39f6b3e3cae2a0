#!/usr/bin/env python3
"""Checks the documents: links have targets, examples run, and the README's figures equal those of BENCHMARK.md.

Runs in an environment with the package planish and its command. Camera examples run on the simulator instead. If the input of a
line is not prepared here (such as a camera's calibration), the command must at least accept its arguments.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import planish

ROOT = Path(__file__).resolve().parent.parent
# The tests' build has every feature; the command installed next to Python cannot read MCAP recordings.
BUILT = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug/planish"
COMMAND = str(BUILT if BUILT.exists() else Path(sys.executable).with_name("planish"))
SHELL = ["README.md", "docs/index.md", "docs/coming-from.md", "docs/cameras.md", "docs/rigs.md", "docs/command-line.md", "crates/planish-cli/README.md"]
PYTHON = ["README.md", "docs/coming-from.md", "crates/planish-python/README.md"]
# Prefixes of packages that are not installed for this check: Open3D, and pyrealsense2, which also needs a camera.
MISSING_PACKAGES = ("o3d.", "rs.")
# Replacements that shorten examples of several minutes.
SHORTER = [("--seeds 4", "--seed 1"), ("--seeds 2", "--seed 1"), ("--rig table/rig.json", "--rig table/rig.json --frames 2"), ("--duration 10", "--frames 2")]

WITHOUT_MCAP = "without the feature mcap"
# `planish view` would serve its page until it is stopped; builds by cargo do not contain the page.
WITHOUT_PAGE = "does not contain the page"

problems: list[str] = []


def tracked(pattern: str) -> list[str]:
    return subprocess.run(["git", "ls-files", pattern], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()


def anchors(text: str) -> set[str]:
    """Returns the anchors of a page's headings, as GitHub generates them."""
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def check_links() -> int:
    count = 0
    for page in tracked("*.md"):
        text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.S)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if re.match(r"[a-z]+:", target):
                continue
            count += 1
            name, _, anchor = target.partition("#")
            file = (ROOT / page).parent / name if name else ROOT / page
            if not file.exists():
                problems.append(f"{page}: the link {target} leads nowhere")
            elif anchor and file.suffix == ".md" and anchor not in anchors(file.read_text(encoding="utf-8")):
                problems.append(f"{page}: {name or page} has no heading #{anchor}")
    return count


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.S | re.M)


def run(line: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([COMMAND, *line], cwd=folder, capture_output=True, text=True)


def prepare(folder: Path) -> None:
    """Creates the files that the examples use."""
    recording = folder / "recording"
    for arguments in (f"record synthetic {recording} --frames 2", "record synthetic drive.mcap --frames 2", "demo --out demo"):
        made = run(shlex.split(arguments), folder)
        assert made.returncode == 0 or WITHOUT_MCAP in made.stderr, made.stderr
    depth = next((recording / "depth").glob("*.png"))
    depth.rename(folder / "depth.png")
    (folder / "camera_info.yaml").write_text(
        "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [525, 0, 319.5, 0, 525, 239.5, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n",
        encoding="utf-8",
    )
    cloud = (folder / "demo/raw.pcd").read_bytes()
    (folder / "frames").mkdir()
    for name in ("cloud.pcd", "frame.pcd", "scan.pcd", "table.pcd", "frames/a.pcd", "frames/b.pcd"):
        (folder / name).write_bytes(cloud)
    points = planish.read(folder / "cloud.pcd").points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)][::4]
    for name in ("scan.laz", "scan.ply"):
        planish.write(folder / name, points)


def check_shell(folder: Path) -> int:
    count = 0
    for page in SHELL:
        text = (ROOT / page).read_text(encoding="utf-8")
        lines = [line for block in blocks(page, "sh") for line in block.splitlines() if line.startswith("planish ")]
        lines += [code for code in re.findall(r"`(planish [^`]+)`", text) if page == "docs/command-line.md"]
        for line in lines:
            shown = line
            for long, short in SHORTER:
                line = line.replace(long, short)
            arguments = shlex.split(line, comments=True)[1:]
            if arguments[0] in ("stream", "record"):
                simulated = [("synthetic" if re.match(r"(realsense|openni2|kinect)\b", word) else word) for word in arguments]
                arguments = simulated if simulated == arguments else [*simulated, "--frames", "2"]
            done = run(arguments, folder)
            count += 1
            if "try '--help'" in done.stderr:
                problems.append(f"{page}: {shown}\n  is not understood: {done.stderr.strip()}")
            elif done.returncode and not re.search(f"[Nn]o such file|{WITHOUT_MCAP}|{WITHOUT_PAGE}", done.stderr):
                problems.append(f"{page}: {shown}\n  failed: {done.stderr.strip()}")
    return count


def check_python(folder: Path) -> int:
    depth = planish.read(folder / "depth.png").depth
    points = planish.read(folder / "cloud.pcd").points
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)][::10]
    table = np.zeros(len(flat), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    table["x"], table["y"], table["z"] = flat.T
    stream, count = planish.stream, 0
    planish.stream = lambda source, **options: stream("synthetic", frames=2, **options)
    try:
        for page in PYTHON:
            for block in blocks(page, "python"):
                if any(package in block for package in MISSING_PACKAGES):
                    compile(block, page, "exec")
                    continue
                count += 1
                names = {
                    "np": np, "planish": planish, "depth": depth, "points": points, "cloud": SimpleNamespace(points=flat), "table": table,
                    "tensor": depth, "camera": planish.Camera(640, 480, fx=525.0, fy=525.0), "paths": [str(folder / "depth.png")],
                    "show": lambda *shown: None,
                }  # fmt: skip
                block = re.sub(r'"((?:scan|smooth)\.\w+)"', lambda name: repr(str(folder / name[1])), block)
                try:
                    exec(compile(block, page, "exec"), names)
                except Exception as error:
                    problems.append(f"{page}: an example fails with {error!r}:\n{block}")
    finally:
        planish.stream = stream
    return count


def check_figures() -> int:
    """Compares the README's table with its source in BENCHMARK.md, the block of compare/accuracy.sh."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    block = (ROOT / "BENCHMARK.md").read_text(encoding="utf-8").split("<!-- compare/accuracy.sh -->")[1].split("<!-- end of")[0]
    block = block.strip().split("\n\n")[1]
    measured = {cells[0]: cells[1:] for cells in ([cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines() if line.startswith("|"))}
    near_steps, edge = (measured[""].index(name) for name in ("near steps", "90° edge"))
    sources = {
        "planish, default": "planish default",
        "PCL `MovingLeastSquares`, plane": "PCL, 3 cm, order 1",
        "PCL, quadratic": "PCL, 3 cm, order 2",
        "Open3D `smooth_mls`, 30 neighbours": "Open3D smooth_mls, 3 cm, max_nn 30",
        "Open3D, all neighbours": "Open3D smooth_mls, 3 cm, all neighbours",
        "OpenCV bilateral": "OpenCV bilateral on depth, 13x13",
    }
    count = 0
    for label, source in sources.items():
        row = re.search(rf"^\| {re.escape(label)}.*$", readme, re.M)
        if row is None:
            problems.append(f"README.md: no row for {label}")
            continue
        cells = [cell.strip().strip("*") for cell in row[0].strip("|").split("|")][1:]
        values = measured[source]
        shares = [f"{100 * float(values[i]):.0f} %" for i in (0, 1, 2, near_steps)]
        expected = [*shares, values[edge]]
        count += len(expected)
        if cells[:5] != expected:
            problems.append(f"README.md: {label} has {cells[:5]}, but BENCHMARK.md {expected}")
    return count


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        counts = [check_links(), check_shell(folder), check_python(folder), check_figures()]
    print("{} links, {} commands, {} Python examples, {} figures".format(*counts))
    assert min(counts) > 0, counts
    if problems:
        sys.exit("\n".join(problems))


if __name__ == "__main__":
    main()
