"""Reads and writes organized PCD clouds of 640x480, as far as the other scripts in this folder need."""

import numpy
import open3d

WIDTH, HEIGHT = 640, 480
FOCAL_PX, CENTRE_X_PX, CENTRE_Y_PX = 525.0, 319.5, 239.5


def write(file, pixels, positions, normals=None):
    """Writes positions, and normals if given, at their pixels; all other pixels are NaN."""
    fields = 3 if normals is None else 6
    values = numpy.full((WIDTH * HEIGHT, fields), numpy.nan, numpy.float32)
    values[pixels, :3] = positions
    if normals is not None:
        values[pixels, 3:] = normals
    names = "x y z normal_x normal_y normal_z".split()[:fields]
    header = [
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE" + " 4" * fields,
        "TYPE" + " F" * fields,
        "COUNT" + " 1" * fields,
        f"WIDTH {WIDTH}",
        f"HEIGHT {HEIGHT}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {WIDTH * HEIGHT}",
        "DATA binary",
    ]
    with open(file, "wb") as out:
        out.write(("\n".join(header) + "\n").encode())
        out.write(values.tobytes())


def read_depth(file):
    """Reads z of an organized PCD as an image in metres, 0 for holes."""
    cloud = open3d.t.io.read_point_cloud(file, remove_nan_points=False)
    return numpy.nan_to_num(cloud.point.positions.numpy()[:, 2].astype(numpy.float32)).reshape(HEIGHT, WIDTH)


def deproject(z):
    """Returns the pixels that have a depth, and their points."""
    v, u = numpy.indices(z.shape)
    points = numpy.stack([(u - CENTRE_X_PX) / FOCAL_PX * z, (v - CENTRE_Y_PX) / FOCAL_PX * z, z], -1).reshape(-1, 3)
    pixels = numpy.flatnonzero(z.reshape(-1) > 0)
    return pixels, points[pixels]
