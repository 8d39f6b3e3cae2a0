"""Draws the pictures of the gallery and of the parameters.

usage: python docs/make_pictures.py DATA

DATA has real frames, as the gallery names them; without one of them its picture is left as it is. Needs the Python package, Pillow and
opencv-python-headless.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import planish
from PIL import Image, ImageDraw

HERE = Path(__file__).parent / "pictures"
CELL = (480, 360)


def relief(file: Path, folder: Path, *arguments: str) -> Image.Image:
    """The relief of a file, without its colours."""
    picture = folder / "relief.png"
    subprocess.run(["planish", "render", file, picture, *arguments], check=True, capture_output=True)
    image = Image.open(picture).convert("RGB")
    # If the file has colours, they are next to the relief.
    return image.crop((0, 0, image.width // 2, image.height)) if image.width > 2 * image.height else image


def smoothed(file: Path, folder: Path, *arguments: str) -> Path:
    result = folder / f"smooth{file.suffix if file.suffix != '.png' else '.pcd'}"
    subprocess.run(["planish", "smooth", file, result, "--overwrite", *arguments], check=True, capture_output=True)
    return result


def side_by_side(name: str, cells: list[tuple[str, Image.Image]], *, full_size: bool = False) -> None:
    """One picture of several, each with its caption, at most three in a row."""
    for _, image in cells:
        if not full_size:
            image.thumbnail(CELL, Image.Resampling.LANCZOS)
    across = 2 if full_size or len(cells) == 4 else len(cells)
    width, height = max(image.width for _, image in cells) + 8, max(image.height for _, image in cells) + 24
    sheet = Image.new("RGB", (across * width - 8, -(-len(cells) // across) * height), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (caption, image) in enumerate(cells):
        x, y = i % across * width, i // across * height
        sheet.paste(image, (x, y + 24))
        draw.text((x + 4, y + 4), caption, fill="black", font_size=15)
    HERE.mkdir(exist_ok=True)
    sheet.quantize(128).save(HERE / f"{name}.png", optimize=True)
    print(name)


def gallery(data: Path, folder: Path) -> None:
    tum = ["--camera", "525,525,319.5,239.5", "--depth-units-per-metre", "5000"]
    mm = ["--camera", "525,525,319.5,239.5"]
    frames = [
        ("kinect-table", "kinect/milk_cartoon_all_small_clorox.pcd", [], []),
        ("kinect-office", "kinect/office1.pcd", [], []),
        ("tum-desk", "tum/TUM_depth.png", tum, tum),
        ("aerial", "unorganized/autzen_trim.laz", [], ["--neighbours", "60"]),
    ]
    redwood = sorted((data / "redwood").glob("**/*depth*/*.png")) or sorted((data / "redwood").glob("**/depth*.png"))
    frames += [("redwood-room", str(path.relative_to(data)), mm, mm) for path in redwood[:1]]
    for name, file, how_drawn, how_smoothed in frames:
        path = data / file
        if not path.exists():
            print(f"{name}: left as it is, without {path}")
            continue
        is_depth = path.suffix == ".png"
        result = smoothed(path, folder, *how_smoothed)
        side_by_side(
            name,
            [
                ("raw", relief(path, folder, *how_drawn)),
                ("smoothed", relief(result, folder, *([] if is_depth else how_drawn))),
            ],
        )


def video(folder: Path) -> None:
    """Frames of a camera that is carried: measured, smoothed one by one, and steady."""
    command = ["planish", "evaluate", "--sequence", "moving-camera", "--sensor", "d435", "--frames", "40", "--out", folder]
    subprocess.run(command, check=True, capture_output=True)
    animation = Image.open(folder / "moving-camera.png")
    frames = []
    for number in range(8):
        animation.seek(number)
        # Three panels of 320x240 pixels with lines of 4 pixels between them.
        cells = [animation.convert("L").crop((324 * k + 60, 30, 324 * k + 260, 180)) for k in range(3)]
        frame = Image.new("L", (608, 150), 255)
        for k, cell in enumerate(cells):
            frame.paste(cell, (204 * k, 0))
        # Fewer shades make a smaller file.
        frames.append(frame.point(lambda shade: shade // 4 * 4))
    frames[0].save(HERE / "video.png", save_all=True, append_images=frames[1:], duration=80, loop=0)


def objects(folder: Path) -> None:
    """Curved objects at full size: one pixel of the picture is one pixel of the frame."""
    frame = planish.simulate("curves", seed=3)
    camera = frame.camera
    of_camera = ["--camera", f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}"]
    raw, truth = folder / "curves.png", folder / "truth.pcd"
    planish.write(raw, frame.depth)
    planish.write(truth, frame.points)
    depth_m = frame.depth.astype(np.float32) / camera.depth_units_per_metre
    bilateral_m = cv2.bilateralFilter(depth_m, 13, 0.03, 4.0)
    bilateral_m[depth_m == 0] = np.nan
    bilateral = folder / "bilateral.npy"
    planish.write(bilateral, bilateral_m)
    cells = [("raw", relief(raw, folder, *of_camera))]
    for preset in ["light", "default", "strong"]:
        cells.append((f"--preset {preset}", relief(smoothed(raw, folder, *of_camera, "--preset", preset), folder)))
    cells.append(("OpenCV bilateral, 13x13", relief(bilateral, folder, *of_camera)))
    cells.append(("truth", relief(truth, folder)))
    box = (90, 60, 560, 420)
    side_by_side("objects", [(caption, image.crop(box)) for caption, image in cells], full_size=True)


def parameters(folder: Path) -> None:
    frame = planish.simulate("shapes", seed=2)
    path = folder / "shapes.png"
    planish.write(path, frame.depth)
    of_camera = frame.camera
    camera = ["--camera", f"{of_camera.fx},{of_camera.fy},{of_camera.cx},{of_camera.cy}"]
    camera += ["--depth-units-per-metre", str(of_camera.depth_units_per_metre)]

    def of(*arguments: str) -> Image.Image:
        return relief(smoothed(path, folder, *camera, *arguments), folder)

    strengths = [(f"--strength {strength}", of("--strength", strength)) for strength in ["0", "0.5", "1"]]
    side_by_side("strength", [("raw", relief(path, folder, *camera)), *strengths])
    edges = ["robust", "off"]
    side_by_side("edges", [(f"--edges {edge}", of("--edges", edge)) for edge in edges])
    blocks = [("--average-blocks false", "false"), ("--average-blocks true", "true")]
    side_by_side("blocks", [(caption, of("--average-blocks", value)) for caption, value in blocks])
    degrees = ["1", "2", "3"]
    side_by_side("degree", [(f"--degree {degree}", of("--degree", degree)) for degree in degrees])
    side_by_side("project", [(f"--project {to}", of("--project", to)) for to in ["ray", "normal"]])
    sensors = ["kinect1", "d435", "azure-kinect", "exact"]
    side_by_side("sensor", [(f"--sensor {sensor}", of("--sensor", sensor)) for sensor in sensors])


with tempfile.TemporaryDirectory() as work:
    parameters(Path(work))
    objects(Path(work))
    video(Path(work))
    if len(sys.argv) > 1:
        gallery(Path(sys.argv[1]), Path(work))
