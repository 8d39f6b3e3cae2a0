"""Does ten things with planish and with Open3D: runs both, and counts their lines.

usage: python compare/ten_things.py OUTPUT.md

Both functions of a pair get the same inputs and return the same kind of result, which is checked. A line is a statement as written; imports at
the top are not counted. Uses Open3D 0.20 from PyPI, and laspy for LAS, which Open3D does not read.
"""

import inspect
import sys
import tempfile
import textwrap
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import planish
from PIL import Image

FX, FY, CX, CY = 525.0, 525.0, 319.5, 239.5


class PlanishWay:
    """One function per task; the arguments are the same in both classes."""

    def depth_image_to_points(depth_png):
        depth = planish.read(depth_png).depth
        return planish.smooth(depth, planish.Camera(640, 480, FX, FY)).points

    def depth_image_to_depth_image(depth_png, out_png):
        depth = planish.read(depth_png).depth
        smooth = planish.smooth(depth, planish.Camera(640, 480, FX, FY), outputs=["depth"]).depth
        planish.write(out_png, smooth)

    def folder_of_depth_images(folder, out_folder):
        for frame in planish.stream(folder, planish.Camera(640, 480, FX, FY), outputs=["depth"]):
            planish.write(out_folder / f"{frame.name}.png", frame.smoothed.depth)

    def array_of_points(points):
        return planish.smooth(points).points

    def points_with_normals_to_the_sensor(points):
        result = planish.smooth(points)
        return result.points, result.normals

    def fixed_radius(points):
        return planish.smooth(points, radius=0.05).points

    def file_to_file(cloud_pcd, out_ply):
        cloud = planish.read(cloud_pcd)
        cloud.points = planish.smooth(cloud).points
        planish.write(out_ply, cloud)

    def curvature(points):
        return planish.smooth(points, outputs=["curvature"]).curvature

    def which_points_are_isolated(points):
        return planish.smooth(points, outputs=["status"]).status == planish.Status.ISOLATED

    def laser_scan(scan_las, out_las):
        scan = planish.read(scan_las)
        scan.points = planish.smooth(scan).points
        planish.write(out_las, scan)


class Open3dWay:
    def depth_image_to_points(depth_png):
        depth = o3d.io.read_image(str(depth_png))
        camera = o3d.camera.PinholeCameraIntrinsic(640, 480, FX, FY, CX, CY)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(depth, camera)
        return np.asarray(cloud.smooth_mls(o3d.geometry.KDTreeSearchParamHybrid(0.03, 30)).points)

    def depth_image_to_depth_image(depth_png, out_png):
        depth = o3d.io.read_image(str(depth_png))
        camera = o3d.camera.PinholeCameraIntrinsic(640, 480, FX, FY, CX, CY)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(depth, camera)
        smooth = cloud.smooth_mls(o3d.geometry.KDTreeSearchParamHybrid(0.03, 30))
        tensor = o3d.t.geometry.PointCloud.from_legacy(smooth)
        image = tensor.project_to_depth_image(640, 480, camera.intrinsic_matrix, depth_max=10.0)
        raw = np.asarray(image.to_legacy()).round().astype(np.uint16)
        o3d.io.write_image(str(out_png), o3d.geometry.Image(raw))

    def folder_of_depth_images(folder, out_folder):
        camera = o3d.camera.PinholeCameraIntrinsic(640, 480, FX, FY, CX, CY)
        for path in sorted(folder.glob("*.png")):
            cloud = o3d.geometry.PointCloud.create_from_depth_image(o3d.io.read_image(str(path)), camera)
            smooth = cloud.smooth_mls(o3d.geometry.KDTreeSearchParamHybrid(0.03, 30))
            tensor = o3d.t.geometry.PointCloud.from_legacy(smooth)
            image = tensor.project_to_depth_image(640, 480, camera.intrinsic_matrix, depth_max=10.0)
            raw = np.asarray(image.to_legacy()).round().astype(np.uint16)
            o3d.io.write_image(str(out_folder / path.name), o3d.geometry.Image(raw))

    def array_of_points(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        return np.asarray(cloud.smooth_mls(o3d.geometry.KDTreeSearchParamKNN(40)).points)

    def points_with_normals_to_the_sensor(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        smooth = cloud.smooth_mls(o3d.geometry.KDTreeSearchParamKNN(40))
        smooth.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(40))
        smooth.orient_normals_towards_camera_location()
        return np.asarray(smooth.points), np.asarray(smooth.normals)

    def fixed_radius(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        return np.asarray(cloud.smooth_mls(o3d.geometry.KDTreeSearchParamRadius(0.05)).points)

    def file_to_file(cloud_pcd, out_ply):
        cloud = o3d.io.read_point_cloud(str(cloud_pcd))
        smooth = cloud.smooth_mls(o3d.geometry.KDTreeSearchParamKNN(40))
        smooth.colors = cloud.colors
        o3d.io.write_point_cloud(str(out_ply), smooth)

    def curvature(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_covariances(search_param=o3d.geometry.KDTreeSearchParamKNN(40))
        values = np.linalg.eigvalsh(np.asarray(cloud.covariances))
        return values[:, 0] / values.sum(axis=1)

    def which_points_are_isolated(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        _, kept = cloud.remove_statistical_outlier(nb_neighbors=40, std_ratio=3.0)
        return ~np.isin(np.arange(len(points)), kept)

    def laser_scan(scan_las, out_las):
        scan = laspy.read(scan_las)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.xyz))
        scan.xyz = np.asarray(cloud.smooth_mls(o3d.geometry.KDTreeSearchParamKNN(40)).points)
        scan.write(out_las)


def body(way, name):
    """Returns the statements of a function."""
    lines = inspect.getsource(getattr(way, name)).splitlines()[1:]
    return textwrap.dedent("\n".join(lines)).strip()


def results(way, folder):
    """Runs the ten tasks of a class on the same inputs, and returns their results."""
    frame = planish.simulate("table", seed=3)
    (folder / "in").mkdir()
    (folder / "out").mkdir()
    for name in ["a.png", "b.png"]:
        planish.write(folder / "in" / name, frame.depth)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.random((4000, 2)), rng.normal(0, 0.004, 4000)])
    points[7] = [0.5, 0.5, 3.0]
    planish.write(folder / "a.pcd", points.astype(np.float32), fields={"rgb": np.arange(4000, dtype=np.uint32)})
    planish.write(folder / "a.las", points + [1000.0, 2000.0, 50.0])
    found = {
        "depth_image_to_points": way.depth_image_to_points(folder / "in" / "a.png"),
        "array_of_points": way.array_of_points(points),
        "points_with_normals_to_the_sensor": way.points_with_normals_to_the_sensor(points - [0.5, 0.5, -2.0])[1],
        "fixed_radius": way.fixed_radius(points),
        "curvature": way.curvature(points),
        "which_points_are_isolated": way.which_points_are_isolated(points),
    }
    way.depth_image_to_depth_image(folder / "in" / "a.png", folder / "out.png")
    way.folder_of_depth_images(folder / "in", folder / "out")
    way.file_to_file(folder / "a.pcd", folder / "out.ply")
    way.laser_scan(folder / "a.las", folder / "out.las")
    found["depth_image_to_depth_image"] = np.asarray(Image.open(folder / "out.png"))
    found["folder_of_depth_images"] = sum(path.stat().st_size > 1000 for path in (folder / "out").glob("*.png"))
    found["file_to_file"] = planish.read(folder / "out.ply").points
    found["laser_scan"] = laspy.read(folder / "out.las").xyz
    return found


def check(found):
    """Checks that each result is correct."""
    assert np.nanmedian(found["depth_image_to_points"][..., 2]) > 0.5
    assert np.median(found["depth_image_to_depth_image"][found["depth_image_to_depth_image"] > 0]) > 500
    assert found["folder_of_depth_images"] == 2
    for name in ["array_of_points", "fixed_radius", "file_to_file"]:
        assert np.std(np.delete(found[name][:, 2], 7)) < 0.0035, name
    assert np.std(np.delete(found["laser_scan"][:, 2], 7)) < 0.0035
    normals = np.delete(found["points_with_normals_to_the_sensor"], 7, axis=0)
    assert np.mean(normals[:, 2] < 0) > 0.99
    assert np.nanmedian(found["curvature"]) < 0.1
    assert found["which_points_are_isolated"][7] and found["which_points_are_isolated"].mean() < 0.1


def main() -> None:
    for way in (PlanishWay, Open3dWay):
        with tempfile.TemporaryDirectory() as folder:
            check(results(way, Path(folder)))
    tasks = [name for name in vars(PlanishWay) if not name.startswith("_")]
    rows, total = [], [0, 0]
    for name in tasks:
        lines = [len(body(way, name).splitlines()) for way in (PlanishWay, Open3dWay)]
        total = [sum(pair) for pair in zip(total, lines, strict=True)]
        rows.append((name.replace("_", " "), lines))
    text = ["| | planish | Open3D |", "|---|---|---|"]
    text += [f"| {name} | {ours} | {theirs} |" for name, (ours, theirs) in rows]
    text += [f"| total | {total[0]} | {total[1]} |", ""]
    for name in tasks:
        text += [f"??? note \"{name.replace('_', ' ')}\"", ""]
        for title, way in [("planish", PlanishWay), ("Open3D", Open3dWay)]:
            text += [f'    === "{title}"', "", "        ```python"]
            text += ["        " + line for line in body(way, name).splitlines()]
            text += ["        ```", ""]
    head = """# Ten tasks in planish and in Open3D

The table counts the lines of Python that each library needs for the same inputs and the same kind of result. `compare/ten_things.py` runs and checks
both columns and generates this page. By default, planish fits polynomials; Open3D fits planes.

"""
    Path(sys.argv[1]).write_text(head + "\n".join(text).rstrip() + "\n")
    print("\n".join(text[: len(rows) + 3]))


main()
