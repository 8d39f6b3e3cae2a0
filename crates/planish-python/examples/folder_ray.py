"""Smooth a folder of depth images with Ray Data: PNG in, PNG out, one actor per core (or per GPU).

python folder_ray.py FRAMES OUT --camera 525,525,319.5,239.5 [--gpus]

Images that OUT already contains are skipped, so an interrupted run can be resumed. Files are written atomically, so a
killed worker loses nothing. Files that cannot be smoothed are listed in OUT/errors.csv, and the run continues with the
others.
"""

import argparse
import csv
import os
from pathlib import Path

import ray

import planish


class SmoothFiles:
    """An actor that smooths the files of a batch one after another."""

    def __init__(self, camera: planish.Camera, out: str, engine: str) -> None:
        self.smoother = planish.Smoother(camera, outputs=["depth"], engine=engine, threads=1)
        self.out = Path(out)

    def __call__(self, batch: dict) -> dict:
        errors = []
        for path in batch["path"]:
            try:
                depth = self.smoother.smooth(planish.read(path).array).depth
                planish.write(self.out / Path(path).name, depth)
                errors.append("")
            except (OSError, TypeError, ValueError) as error:
                errors.append(str(error))
        # Pass on the paths instead of the images, which would cost more than the smoothing.
        return {"path": batch["path"], "error": errors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--camera", required=True, help="FX,FY,CX,CY in pixels")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--gpus", action="store_true", help="run one actor per GPU")
    args = parser.parse_args()
    width, height = (int(value) for value in args.size.split("x"))
    camera = planish.Camera(width, height, *(float(value) for value in args.camera.split(",")))
    args.out.mkdir(parents=True, exist_ok=True)
    paths = [str(path) for path in sorted(args.frames.glob("*.png")) if not (args.out / path.name).exists()]
    if not paths:
        return
    ray.init(logging_level="warning")
    frames = ray.data.from_items([{"path": path} for path in paths], override_num_blocks=4 * args.workers)
    resources = {"num_gpus": 1} if args.gpus else {"num_cpus": 1}
    # Ray repeats the batch of a lost worker, which writes the same files with the same contents.
    done = frames.map_batches(
        SmoothFiles,
        fn_constructor_args=(camera, str(args.out), "gpu" if args.gpus else "cpu"),
        batch_size=8,
        compute=ray.data.ActorPoolStrategy(size=args.workers),
        **resources,
    )
    failed = [row for row in done.take_all() if row["error"]]
    if failed:
        with open(args.out / "errors.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, ["path", "error"])
            writer.writeheader()
            writer.writerows(failed)
        print(f"{len(failed)} of {len(paths)} files could not be smoothed: see {args.out / 'errors.csv'}")


if __name__ == "__main__":
    main()
