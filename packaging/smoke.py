#!/usr/bin/env python3
"""Runs a build of planish for another system and compares its output with that of this machine's own build.

    packaging/smoke.py NATIVE PROGRAM [ARGUMENT...]

NATIVE is this machine's planish; the rest starts the other build, such as `wine planish.exe` or `qemu-aarch64 planish`. Covers the demo,
files of several formats, a folder, standard input and output, names with spaces and non-ASCII letters, existing outputs, damaged
files and Ctrl-C. Points must equal those of the native build within the limits of docs/method.md, section 9.
"""

import json
import pathlib
import signal
import subprocess
import sys
import tempfile
import time

# Limit of the distance between points in metres. Section 9 allows 6e-4 m for single points of a default frame, and at most ten times that with
# edges kept.
LIMIT_M = "6e-3"
failures = []


def expect(is_true, what):
    print(f"{'ok' if is_true else 'FAILED'}  {what}", flush=True)
    if not is_true:
        failures.append(what)


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    sys.stdout.reconfigure(encoding="utf-8")
    native, other = [str(pathlib.Path(sys.argv[1]).resolve())], sys.argv[2:]
    # The other build runs in another folder, so its path must be absolute.
    other = [str(pathlib.Path(part).resolve()) if pathlib.Path(part).is_file() else part for part in other]

    def run(command, *arguments, **options):
        return subprocess.run([*command, *arguments], capture_output=True, timeout=600, **options)

    def same(a, b):
        """Returns whether all distances are within the limit, and the largest distance or the program's message."""
        if a.read_bytes() == b.read_bytes():
            return True, "bit for bit"
        found = run(native, "compare", str(a), str(b), "--max", LIMIT_M, "--json")
        report = json.loads(found.stdout) if found.stdout else {}
        return found.returncode == 0, f"within {report.get('max_distance_m', report)}" if found.stdout else found.stderr.decode()

    with tempfile.TemporaryDirectory(prefix="planish smoke ") as folder:
        root = pathlib.Path(folder) / "Prüfung 試験 b"
        root.mkdir()
        at = root.joinpath
        version = run(other, "--version", cwd=root)
        expect(version.stdout.decode().split()[:1] == ["planish"], f"--version: {version.stdout.decode().strip()}")
        found = run(other, "demo", "--out", "demo", cwd=root)
        expect(found.returncode == 0 and at("demo", "before-after.png").stat().st_size > 100_000, "demo")

        # Create inputs from the demo's frame.
        assert run(native, "demo", "--out", str(at("inputs"))).returncode == 0
        at("inputs", "raw.pcd").rename(at("räw cloud.pcd"))
        for name in ("depth.png", "cloud.ply", "cloud.laz"):
            made = run(native, "convert", str(at("räw cloud.pcd")), str(at(name)))
            assert made.returncode == 0, made.stderr.decode()
        at("frames 帧").mkdir()
        for i in range(3):
            at("frames 帧", f"{i:06}.png").write_bytes(at("depth.png").read_bytes())

        camera = ["--camera", "525,525,319.5,239.5"]
        cases = [("depth.png", "pcd", camera), ("räw cloud.pcd", "pcd", []), ("cloud.ply", "ply", []), ("cloud.laz", "laz", ["--neighbours", "40"])]
        for name, extension, options in cases:
            for command, out in ((native, "native"), (other, "other, ünïcode")):
                found = run(command, "smooth", name, f"{out}{name[-4:]}.{extension}", "--engine", "cpu", "--overwrite", *options, cwd=root)
                if found.returncode:
                    expect(False, f"smooth {name} by {out}: {found.stderr.decode()}")
            is_same, how = same(at(f"native{name[-4:]}.{extension}"), at(f"other, ünïcode{name[-4:]}.{extension}"))
            expect(is_same, f"smooth {name}: {how}")

        found = run(other, "smooth", "räw cloud.pcd", "räw cloud.pcd", cwd=root)
        expect(found.returncode == 2 and b"--overwrite" in found.stderr, "an output that is the input is refused")
        at("copy.pcd").write_bytes(at("räw cloud.pcd").read_bytes())
        found = run(other, "smooth", "copy.pcd", "copy.pcd", "--overwrite", "--engine", "cpu", cwd=root)
        is_same, how = same(at("native.pcd.pcd"), at("copy.pcd"))
        expect(found.returncode == 0 and is_same, f"and replaced with --overwrite: {how}")
        found = run(other, "smooth", "frames 帧", "out 帧", "--engine", "cpu", *camera, cwd=root)
        written = sorted(path.name for path in at("out 帧").glob("*")) if at("out 帧").exists() else []
        expect(found.returncode == 0 and len(written) >= 3, f"a folder: {written} {found.stderr.decode()[-300:] if found.returncode else ''}")
        piped = run(other, "smooth", "-", "piped.pcd", "--engine", "cpu", input=at("räw cloud.pcd").read_bytes(), cwd=root)
        is_same, how = same(at("native.pcd.pcd"), at("piped.pcd")) if piped.returncode == 0 else (False, piped.stderr.decode())
        expect(piped.returncode == 0 and is_same, f"standard input: {how}")
        at("cut.png").write_bytes(at("depth.png").read_bytes()[:20_000])
        found = run(other, "smooth", "cut.png", "cut.pcd", *camera, cwd=root)
        expect(found.returncode == 2 and b"cut.png" in found.stderr and not at("cut.pcd").exists(), "a damaged file is an error that names it")
        found = run(other, "info", "räw cloud.pcd", "--json", cwd=root)
        expect(found.returncode == 0 and json.loads(found.stdout), "info --json")
        found = run(other, "devices", cwd=root)
        expect(found.returncode == 0, f"devices: {' | '.join(found.stdout.decode().splitlines()[:6])}")

        if sys.platform == "win32":
            print("SKIP  Ctrl-C: a console would send it to this script too")
            sys.exit(f"{len(failures)} failed" if failures else 0)
        # Ctrl-C must end the stream, which prints its report and leaves no temporary file.
        streaming = subprocess.Popen([*other, "stream", "räw cloud.pcd", "--engine", "cpu", "--save", "saved", "--fps", "5"], cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        time.sleep(6)
        streaming.send_signal(signal.SIGINT)
        try:
            output, errors = streaming.communicate(timeout=60)
            left = [str(path.name) for path in root.rglob("*") if ".tmp" in path.name or path.name.startswith(".")]
            saved = len(list(root.glob("saved*/**/*")))
            expect(streaming.returncode in (0, 130) and saved > 0 and not left, f"Ctrl-C: exit {streaming.returncode}, {saved} files, left {left}")
        except subprocess.TimeoutExpired:
            streaming.kill()
            expect(False, "Ctrl-C ends the stream within a minute")
    if failures:
        sys.exit(f"{len(failures)} failed")


main()
