"""Smooth depth images from a folder or an object store with Ray Data: PNG in, a row of Parquet or Lance per frame out.

python frames_to_parquet.py FRAMES OUT --camera 525,525,319.5,239.5 [--lance]

FRAMES and OUT may be folders or addresses such as s3://bucket/frames. A row contains the path,
the smoothed depth (uint16, height x width, as bytes) and an error message, which is empty on success. Paths that OUT
already contains are skipped, so an interrupted run can be resumed. To read a row:
np.frombuffer(row["smoothed"], np.uint16).reshape(480, 640).
"""

import argparse
import io
import os

import numpy as np
import ray
from PIL import Image

import planish
from planish.data import SmoothFrames


def decode(batch: dict) -> dict:
    """Decode PNGs to uint16 arrays; data that cannot be decoded give an empty array."""

    def depth_of(data: bytes) -> np.ndarray:
        try:
            return np.asarray(Image.open(io.BytesIO(data))).astype(np.uint16)
        except (OSError, ValueError):
            return np.empty((0, 0), np.uint16)

    return {"path": batch["path"], "depth": [depth_of(data) for data in batch["bytes"]]}


class Smooth:
    """An actor with a smoother; it passes on the results as bytes."""

    def __init__(self, camera: planish.Camera) -> None:
        self.smooth = SmoothFrames(camera, engine="cpu")

    def __call__(self, batch: dict) -> dict:
        done = self.smooth(decode(batch))
        rows = [np.ascontiguousarray(depth).tobytes() for depth in done["smoothed"]]
        return {"path": done["path"], "smoothed": rows, "error": done["error"]}


def done_already(out: str, lance: bool) -> set[str]:
    read = ray.data.read_lance if lance else ray.data.read_parquet
    try:
        return {row["path"] for row in read(out, columns=["path"]).iter_rows()}
    except (FileNotFoundError, ValueError):
        return set()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames")
    parser.add_argument("out")
    parser.add_argument("--camera", required=True, help="FX,FY,CX,CY in pixels")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--lance", action="store_true", help="write Lance (Ray 2.60 writes it with pylance 1 to 3)")
    args = parser.parse_args()
    width, height = (int(value) for value in args.size.split("x"))
    camera = planish.Camera(width, height, *(float(value) for value in args.camera.split(",")))
    ray.init(logging_level="warning")
    frames = ray.data.read_binary_files(
        args.frames, file_extensions=["png"], include_paths=True, override_num_blocks=4 * args.workers
    )
    done = done_already(args.out, args.lance)
    if done:
        frames = frames.filter(lambda row: row["path"] not in done)
    smoothed = frames.map_batches(
        Smooth,
        fn_constructor_args=(camera,),
        batch_size=8,
        # Reserve half a core per actor. If actors reserved all cores, reading and writing would wait forever.
        num_cpus=0.5,
        compute=ray.data.ActorPoolStrategy(size=args.workers),
    )
    if args.lance:
        smoothed.write_lance(args.out, mode="append" if done else "create")
    else:
        smoothed.write_parquet(args.out)


if __name__ == "__main__":
    main()
