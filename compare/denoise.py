"""Smooths noisy clouds of known shapes with PCL, Open3D and planish, and measures their distances from the shapes.

usage: denoise.py PLANISH PCL_MLS FOLDER POINTS[,POINTS ..] [MESH ..]

Shapes fill the unit sphere and are sampled evenly (Poisson disk). CD is the Chamfer distance to the noiseless points, the sum of the mean
squared distances in both directions. P2M is the mean squared distance of the points from the mesh. Both are multiplied by 10,000.
"""

import pathlib
import subprocess
import sys
import time

import numpy
import open3d

NOISE = (0.01, 0.02, 0.03)
# Candidate numbers of neighbours. For programs that do not choose the number, the best one by the truth is used.
NEIGHBOURS = (30, 60, 120, 240, 480)


def waves():
    """Returns a wavy sheet."""
    x, y = (axis.ravel() for axis in numpy.meshgrid(numpy.linspace(-1, 1, 200), numpy.linspace(-1, 1, 200)))
    corners = numpy.arange(200 * 199).reshape(199, 200)[:, :-1].ravel()
    triangles = numpy.vstack([numpy.stack([corners, corners + 1, corners + 200], 1), numpy.stack([corners + 1, corners + 201, corners + 200], 1)])
    vertices = numpy.stack([x, y, 0.2 * numpy.sin(4 * x) * numpy.cos(4 * y)], 1)
    return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles))


def shapes(files):
    """Returns all meshes by name, in the unit sphere."""
    create = open3d.geometry.TriangleMesh
    meshes = {
        "sphere": create.create_sphere(1, 100),
        "torus": create.create_torus(0.7, 0.3, 200, 100),
        "cylinder": create.create_cylinder(0.3, 1.8, 200),
        "cube": create.create_box(),
        "waves": waves(),
        "thin wall": create.create_box(1, 1, 0.04),
    }
    for file in files:
        meshes[pathlib.Path(file).stem] = open3d.io.read_triangle_mesh(file)
    for mesh in meshes.values():
        mesh.translate(-mesh.get_axis_aligned_bounding_box().get_center())
        mesh.scale(1 / numpy.linalg.norm(numpy.asarray(mesh.vertices), axis=1).max(), numpy.zeros(3))
    return meshes


class Truth:
    """A mesh and noiseless points on it."""

    def __init__(self, mesh, points):
        self.points = mesh.sample_points_poisson_disk(points)
        self.scene = open3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))

    def scores(self, positions):
        """Returns (CD, P2M)."""
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions))
        there, back = (numpy.square(numpy.asarray(a.compute_point_cloud_distance(b))) for a, b in ((cloud, self.points), (self.points, cloud)))
        from_mesh = self.scene.compute_distance(positions.astype(numpy.float32)).numpy()
        return 1e4 * (there.mean() + back.mean()), 1e4 * numpy.square(from_mesh).mean()


def by_planish(*options):
    """Returns a function that smooths a file with these options."""

    def smooth(file, _radius, output):
        command = [planish, "smooth", str(file), str(output.with_suffix(".ply")), "--engine", "cpu", "--threads", "2", *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return numpy.asarray(open3d.io.read_point_cloud(str(output.with_suffix(".ply"))).points)

    return smooth


def by_pcl(degree):
    """Returns a function that smooths a file with PCL."""

    def smooth(file, radius, output):
        subprocess.run([pcl_mls, str(file), "kdtree", str(radius), str(degree), "1", "1", str(output)], check=True, stdout=subprocess.DEVNULL)
        return numpy.asarray(open3d.io.read_point_cloud(str(output), remove_nan_points=True).points)

    return smooth


def by_open3d(file, radius, _output):
    """Smooths a file with Open3D."""
    cloud = open3d.io.read_point_cloud(str(file))
    return numpy.asarray(cloud.smooth_mls(open3d.geometry.KDTreeSearchParamRadius(radius)).points)


def radius_of(positions, neighbours):
    """Returns the median of the radii within which points have this many neighbours."""
    tree = open3d.geometry.KDTreeFlann(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions)))
    return numpy.median([numpy.sqrt(tree.search_knn_vector_3d(p, neighbours)[2][-1]) for p in positions[:: len(positions) // 200]])


def best(smooth, truth, file, positions, output, chooses):
    """Returns the scores and the seconds of the run with the best radius by P2M, or of the only run of a program that chooses the radius."""
    runs = []
    for neighbours in (None,) if chooses else NEIGHBOURS:
        radius = None if chooses else radius_of(positions, neighbours)
        start = time.perf_counter()
        result = smooth(file, radius, output)
        runs.append((truth.scores(result), time.perf_counter() - start))
    return min(runs, key=lambda run: run[0][1])


planish, pcl_mls, folder = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
folder.mkdir(parents=True, exist_ok=True)
methods = {
    "PCL, order 2, best of 5 radii": (by_pcl(2), False),
    "Open3D `smooth_mls`, best of 5 radii": (by_open3d, False),
    "planish, 40 neighbours": (by_planish("--neighbours", "40"), True),
    "planish": (by_planish(), True),
    "planish `--even`": (by_planish("--even"), True),
}
random = numpy.random.default_rng(1)
meshes = shapes(sys.argv[5:])
for points in map(int, sys.argv[4].split(",")):
    print(f"**{points:,} points**, CD / P2M; seconds include reading and writing, of the best radius only\n")
    for noise in NOISE:
        print(f"| noise {100 * noise:.0f} % | {' | '.join(meshes)} | seconds |\n|---|{'---|' * (len(meshes) + 1)}")
        rows = {name: [] for name in ("noisy", *methods)}
        seconds = dict.fromkeys(rows, 0.0)
        for shape, mesh in meshes.items():
            open3d.utility.random.seed(1)
            truth = Truth(mesh, points)
            positions = numpy.asarray(truth.points.points) + random.normal(0, noise, (points, 3))
            file = folder / "noisy.pcd"
            open3d.io.write_point_cloud(str(file), open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions)))
            rows["noisy"].append(truth.scores(positions))
            for name, (smooth, chooses) in methods.items():
                scores, took = best(smooth, truth, file, positions, folder / "out.pcd", chooses)
                rows[name].append(scores)
                seconds[name] += took
        for name, scores in rows.items():
            print(f"| {name} | " + " | ".join(f"{cd:.2f} / {p2m:.2f}" for cd, p2m in scores) + f" | {seconds[name]:.1f} |")
        print(flush=True)
