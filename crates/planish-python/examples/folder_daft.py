"""Smooth a folder of depth images with Daft: PNG in, PNG out, one process per core.

python folder_daft.py FRAMES OUT --camera 525,525,319.5,239.5

Images that OUT already contains are skipped, so an interrupted run can be resumed. Files are written atomically. If a
worker is killed, Daft ends the run; start it again. Files that cannot be smoothed are listed in OUT/errors.csv, and the
run continues with the others.
"""

import argparse
import csv
import os
from pathlib import Path

import daft

import planish


@daft.cls(use_process=True, max_concurrency=os.cpu_count())
class SmoothFiles:
    """Smooths one file after another, with one smoother per process."""

    def __init__(self, camera: planish.Camera, out: str) -> None:
        self.smoother = planish.Smoother(camera, outputs=["depth"], engine="cpu", threads=1)
        self.out = Path(out)

    def __call__(self, path: str) -> str:
        try:
            depth = self.smoother.smooth(planish.read(path).array).depth
            planish.write(self.out / Path(path).name, depth)
        except (OSError, TypeError, ValueError) as error:
            return str(error)
        return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--camera", required=True, help="FX,FY,CX,CY in pixels")
    parser.add_argument("--size", default="640x480")
    args = parser.parse_args()
    width, height = (int(value) for value in args.size.split("x"))
    camera = planish.Camera(width, height, *(float(value) for value in args.camera.split(",")))
    args.out.mkdir(parents=True, exist_ok=True)
    paths = [str(path) for path in sorted(args.frames.glob("*.png")) if not (args.out / path.name).exists()]
    if not paths:
        return
    smooth = SmoothFiles(camera, str(args.out))
    # Without this, Daft makes a single batch, which keeps only one core busy.
    frames = daft.from_pydict({"path": paths}).into_batches(8)
    rows = frames.with_column("error", smooth(daft.col("path"))).to_pylist()
    failed = [row for row in rows if row["error"]]
    if failed:
        with open(args.out / "errors.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, ["path", "error"])
            writer.writeheader()
            writer.writerows(failed)
        print(f"{len(failed)} of {len(paths)} files could not be smoothed: see {args.out / 'errors.csv'}")


if __name__ == "__main__":
    main()
