"""Share of points that lie on a surface, whose distances are kept in the cells of a grid."""

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import share


def measure_shares_on_surface(
    linear, shifts, points, normals, reaches, distances, directions, min_cosine
):
    """Measure the share of points within their reach of a surface, for each similarity.

    `linear` [m, 3, 3] is a rotation times a scale, and with `shifts` [m, 3] takes `points` [n, 3]
    to cells; the grid begins at 0. `reaches` [n] is in the unit of the points. `distances`
    [x, y, z], in cells, and `directions` [x, y, z, 3] are those of the closest point of the
    surface. `normals` [n, 3] and directions count as parallel from `min_cosine` on, whatever their
    sign.
    """
    shares = np.empty(len(linear))
    arguments = (linear, shifts, points, normals, reaches, distances, directions, min_cosine)
    share(_measure_rows, len(linear), *arguments, shares)
    return shares


@njit(nogil=True)
def _measure_rows(
    begin, end, linear, shifts, points, normals, reaches, distances, directions, min_cosine, shares
):
    width, height, length = distances.shape
    for m in range(begin, end):
        a = linear[m]
        scale = np.sqrt(a[0, 0] ** 2 + a[1, 0] ** 2 + a[2, 0] ** 2)
        count = 0
        for n in range(len(points)):
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            x = a[0, 0] * px + a[0, 1] * py + a[0, 2] * pz + shifts[m, 0]
            y = a[1, 0] * px + a[1, 1] * py + a[1, 2] * pz + shifts[m, 1]
            z = a[2, 0] * px + a[2, 1] * py + a[2, 2] * pz + shifts[m, 2]
            reach = scale * reaches[n]
            if not (
                -reach <= x <= width + reach
                and -reach <= y <= height + reach
                and -reach <= z <= length + reach
            ):
                continue
            i = min(max(int(x), 0), width - 1)
            j = min(max(int(y), 0), height - 1)
            k = min(max(int(z), 0), length - 1)
            # Walls lie at the border of the grid. A point beside it is at most as far from the
            # surface as the nearest cell is, and from that cell.
            beside_x = max(-x, x - width, 0.0)
            beside_y = max(-y, y - height, 0.0)
            beside_z = max(-z, z - length, 0.0)
            beside = np.sqrt(beside_x**2 + beside_y**2 + beside_z**2)
            if distances[i, j, k] + beside > reach:
                continue
            nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
            cosine = (
                directions[i, j, k, 0] * (a[0, 0] * nx + a[0, 1] * ny + a[0, 2] * nz)
                + directions[i, j, k, 1] * (a[1, 0] * nx + a[1, 1] * ny + a[1, 2] * nz)
                + directions[i, j, k, 2] * (a[2, 0] * nx + a[2, 1] * ny + a[2, 2] * nz)
            )
            if abs(cosine) >= min_cosine * scale:
                count += 1
        shares[m] = count / len(points)
