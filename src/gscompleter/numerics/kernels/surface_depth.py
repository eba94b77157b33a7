"""z-depth of triangles at the pixels of a camera."""

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import share

SAFE_DEPTH = 1e-12
"""Smallest z-depth of a corner, relative to the farthest one, whose pixel can be computed."""


def draw_depth(corners, faces, width, height):
    """Draw the z-depth of the nearest triangle at each pixel centre; 0 where there is none.

    `corners` [n, 3], float64, are homogeneous pixels (x z, y z, z) of a camera, also behind it;
    `faces` [m, 3], int64, are their indices. Both sides of a triangle are drawn. Nothing is
    checked: a `GivenGeometry` has finite vertices, and faces of vertices that exist.
    """
    depth = np.zeros((height, width), np.float64)
    share(_draw_rows, height, corners, faces, depth)
    return depth


@njit(nogil=True)
def _draw_rows(begin, end, corners, faces, depth):
    width = depth.shape[1]
    for f in range(len(faces)):
        a, b, c = corners[faces[f, 0]], corners[faces[f, 1]], corners[faces[f, 2]]
        farthest = max(a[2], b[2], c[2])
        if farthest <= 0:
            continue

        # The range of pixels around the triangle, with one to spare. A triangle that reaches behind
        # the camera may cover any pixel.
        left = 0
        right = width
        top = begin
        bottom = end
        if min(a[2], b[2], c[2]) > SAFE_DEPTH * farthest:
            ax, bx, cx = a[0] / a[2], b[0] / b[2], c[0] / c[2]
            ay, by, cy = a[1] / a[2], b[1] / b[2], c[1] / c[2]
            # Compared as floats, since corners far beside the image exceed integers.
            left = int(max(min(ax, bx, cx) - 1.0, 0.0))
            right = int(min(max(ax, bx, cx) + 1.0, float(width)))
            top = int(max(min(ay, by, cy) - 1.0, float(begin)))
            bottom = int(min(max(ay, by, cy) + 1.0, float(end)))
        if left >= right or top >= bottom:
            continue

        # The ray of pixel r = (x, y, 1) meets the plane of the triangle at the z-depth
        # volume / (normal · r), and its inside if it lies on one side of all three planes through
        # the camera and an edge: no clipping is needed (homogeneous rasterization).
        ux, uy, uz = _cross(b, c)
        vx, vy, vz = _cross(c, a)
        wx, wy, wz = _cross(a, b)
        volume = a[0] * ux + a[1] * uy + a[2] * uz
        if volume == 0:
            continue
        sign = 1.0 if volume > 0 else -1.0
        for row in range(top, bottom):
            y = row + 0.5
            for column in range(left, right):
                x = column + 0.5
                u = sign * (ux * x + uy * y + uz)
                v = sign * (vx * x + vy * y + vz)
                w = sign * (wx * x + wy * y + wz)
                # Barycentric coordinates times `total`, which is normal · r.
                total = u + v + w
                if u < 0 or v < 0 or w < 0 or total <= 0:
                    continue
                z = sign * volume / total
                if depth[row, column] == 0 or z < depth[row, column]:
                    depth[row, column] = z


@njit(inline="always")
def _cross(p, q):
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )
