"""Projection of Gaussians to splats, and its gradients."""

import math
from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.simd import MIN_ALPHA

TANGENT_MARGIN = np.float32(0.15)
"""Border around the image, relative to its size, at which the Jacobian is clamped: as 3DGS does at
1.3 times the tangent of half the field of view, which is 0.15 of a width beyond either side."""

X, Y, U, V, W, DEPTH, RED, GREEN, BLUE = range(9)
"""Columns of the splats, see `simd.py`."""
NUM_SPLAT_COLUMNS = 9

SUM, SUM_S, SUM_T, SUM_SS, SUM_ST, SUM_TT, SUM_DEPTH, SUM_RED = range(8)
"""Gradient columns: sums of q = alpha dL/dalpha times 1, s, t, s², s t, t²; depth; colours."""
NUM_GRADIENT_COLUMNS = 10


class CameraArrays(NamedTuple):
    """A camera in the form that kernels read."""

    rotation: tuple[np.float32, ...]
    """Camera from world, nine numbers row by row."""
    center: np.ndarray
    """Camera centre in the world [3], float32."""
    intrinsics: np.ndarray
    """fx, fy, cx, cy in pixels [4], float32."""
    near: np.float32
    """Smallest z that is rendered."""
    width: int
    height: int
    padding: tuple[int, int]
    """See `gscompleter.types.Camera`."""
    blur: np.float32
    """Variance by which splats are widened, in square pixels."""


class GaussianArrays(NamedTuple):
    """Gaussians, or their gradients, all float32; see `gscompleter.types.Gaussians`."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


@njit(fastmath={"contract"})
def _multiply(a, b):
    """Multiply 3 × 3 matrices, which are tuples of nine here, row by row."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@njit(fastmath={"contract"})
def _transpose(a):
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@njit(fastmath={"contract"})
def _apply_matrix(a, x, y, z):
    return (
        a[0] * x + a[1] * y + a[2] * z,
        a[3] * x + a[4] * y + a[5] * z,
        a[6] * x + a[7] * y + a[8] * z,
    )


@njit(fastmath={"contract"}, error_model="numpy")
def normalize_quat(quats, i):
    """Return the unit quaternion i, and the factor that normalised it."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    factor = np.float32(1) / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * factor, x * factor, y * factor, z * factor), factor


@njit(fastmath={"contract"})
def rotate_by_quat(quat):
    """Compute the rotation matrix of a unit quaternion, row by row."""
    w, x, y, z = quat
    one = np.float32(1)
    two = np.float32(2)
    return (
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )


@njit(fastmath={"contract"})
def _rotation_backward(quat, d):
    """Compute the gradient of a unit quaternion from that of its rotation matrix."""
    w, x, y, z = quat
    two = np.float32(2)
    return (
        two * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
        two * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - two * x * (d[4] + d[8])),
        two * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - two * y * (d[0] + d[8])),
        two * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - two * z * (d[0] + d[4])),
    )


@njit(fastmath={"contract"})
def _scale_columns(a, scales, i):
    x, y, z = scales[i, 0], scales[i, 1], scales[i, 2]
    return a[0] * x, a[1] * y, a[2] * z, a[3] * x, a[4] * y, a[5] * z, a[6] * x, a[7] * y, a[8] * z


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_tangent_limits(pinhole):
    """Compute the smallest and largest x/z, and y/z, at which the Jacobian is evaluated.

    They are those of the image without its padding, and `TANGENT_MARGIN` around it.
    """
    fx, fy, cx, cy = pinhole.intrinsics
    left, top = pinhole.padding
    cx, cy = cx - np.float32(left), cy - np.float32(top)
    width, height = np.float32(pinhole.width - 2 * left), np.float32(pinhole.height - 2 * top)
    margin_x, margin_y = TANGENT_MARGIN * width, TANGENT_MARGIN * height
    return (
        -(cx + margin_x) / fx,
        (width - cx + margin_x) / fx,
        -(cy + margin_y) / fy,
        (height - cy + margin_y) / fy,
    )


@njit(fastmath={"contract"})
def _compute_jacobian(fx, fy, tan_x, tan_y, inverse_z, limits):
    """Return d pixel x / dx, d pixel x / dz, d pixel y / dy, d pixel y / dz."""
    least_x, largest_x, least_y, largest_y = limits
    xx, yy = fx * inverse_z, fy * inverse_z
    clamped_x = min(max(tan_x, least_x), largest_x)
    clamped_y = min(max(tan_y, least_y), largest_y)
    return xx, -xx * clamped_x, yy, -yy * clamped_y


@njit(fastmath={"contract"})
def _flatten(axes, jacobian):
    """Project the axes of a Gaussian (columns, in the camera) to a 2 × 3 matrix, by rows."""
    xx, xz, yy, yz = jacobian
    return (
        xx * axes[0] + xz * axes[6],
        xx * axes[1] + xz * axes[7],
        xx * axes[2] + xz * axes[8],
        yy * axes[3] + yz * axes[6],
        yy * axes[4] + yz * axes[7],
        yy * axes[5] + yz * axes[8],
    )


# Spherical harmonics in the basis and with the signs of 3DGS, see render/spherical_harmonics.py.
_C0 = np.float32(0.28209479177387814)
_C1 = np.float32(0.4886025119029199)
_C2XY = np.float32(1.0925484305920792)
_C2Z = np.float32(0.31539156525252005)
_C2XX = np.float32(0.5462742152960396)
_C3A = np.float32(0.5900435899266435)
_C3XYZ = np.float32(2.890611442640554)
_C3B = np.float32(0.4570457994644658)
_C3Z = np.float32(0.3731763325901154)
_C3XX = np.float32(1.445305721320277)


@njit(fastmath={"contract"}, error_model="numpy")
def _compute_direction(center, means, i):
    """Compute the unit vector from the camera centre to the mean, and the inverse distance."""
    x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
    inverse = np.float32(1) / math.sqrt(x * x + y * y + z * z)
    return (x * inverse, y * inverse, z * inverse), inverse


@njit(fastmath={"contract"})
def _evaluate_basis(direction, basis):
    """Evaluate 1, 4, 9 or 16 basis functions at a unit direction."""
    x, y, z = direction
    two = np.float32(2)
    three = np.float32(3)
    four = np.float32(4)
    xx, yy, zz = x * x, y * y, z * z
    basis[0] = _C0
    if len(basis) >= 4:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if len(basis) >= 9:
        basis[4] = _C2XY * x * y
        basis[5] = -_C2XY * y * z
        basis[6] = _C2Z * (two * zz - xx - yy)
        basis[7] = -_C2XY * x * z
        basis[8] = _C2XX * (xx - yy)
    if len(basis) >= 16:
        basis[9] = -_C3A * y * (three * xx - yy)
        basis[10] = _C3XYZ * x * y * z
        basis[11] = -_C3B * y * (four * zz - xx - yy)
        basis[12] = _C3Z * z * (two * zz - three * xx - three * yy)
        basis[13] = -_C3B * x * (four * zz - xx - yy)
        basis[14] = _C3XX * z * (xx - yy)
        basis[15] = -_C3A * x * (xx - three * yy)


@njit(fastmath={"contract"})
def _basis_backward(direction, g):
    """Compute the gradient in the direction of the sum of g[k] times basis function k."""
    x, y, z = direction
    two = np.float32(2)
    three = np.float32(3)
    four = np.float32(4)
    six = np.float32(6)
    eight = np.float32(8)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    dx = dy = dz = np.float32(0)
    if len(g) >= 4:
        dx -= _C1 * g[3]
        dy -= _C1 * g[1]
        dz += _C1 * g[2]
    if len(g) >= 9:
        dx += _C2XY * (y * g[4] - z * g[7]) + two * x * (_C2XX * g[8] - _C2Z * g[6])
        dy += _C2XY * (x * g[4] - z * g[5]) - two * y * (_C2XX * g[8] + _C2Z * g[6])
        dz += four * _C2Z * z * g[6] - _C2XY * (y * g[5] + x * g[7])
    if len(g) >= 16:
        dx += _C3XYZ * yz * g[10] - six * _C3Z * xz * g[12] + two * _C3XX * xz * g[14]
        dx += _C3B * (two * xy * g[11] - (four * zz - three * xx - yy) * g[13])
        dx -= _C3A * (six * xy * g[9] + three * (xx - yy) * g[15])
        dy += _C3XYZ * xz * g[10] - six * _C3Z * yz * g[12] - two * _C3XX * yz * g[14]
        dy += _C3B * (two * xy * g[13] - (four * zz - xx - three * yy) * g[11])
        dy += _C3A * (six * xy * g[15] - three * (xx - yy) * g[9])
        dz += _C3XYZ * xy * g[10] + three * _C3Z * (two * zz - xx - yy) * g[12]
        dz += _C3XX * (xx - yy) * g[14] - eight * _C3B * (yz * g[11] + xz * g[13])
    return dx, dy, dz


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def project_splats(begin, end, gaussians, pinhole, splats, boxes, factors):
    """Project the Gaussians begin..end to `splats` and `boxes`, empty if invisible.

    splats [n, 9] receives the centre in pixels, U of the falloff (`simd.py`), z-depth and RGB. Its
    row is not written where the box is empty. A box [n, 4] is (left, right, top, bottom) in whole
    pixels, right and bottom excluded; it encloses the pixels in which alpha reaches 1/255 at the
    given opacity. factors [n] receives the factors on the opacities of antialiased Gaussians, and
    is None for classic ones.
    """
    means, quats, scales, opacities, sh = gaussians
    view = pinhole.rotation
    center = pinhole.center
    near = pinhole.near
    blur = pinhole.blur
    fx, fy, cx, cy = pinhole.intrinsics
    limits = _compute_tangent_limits(pinhole)
    width, height = np.float32(pinhole.width), np.float32(pinhole.height)
    basis = np.empty(sh.shape[1], np.float32)
    zero = np.float32(0)
    half = np.float32(0.5)
    one = np.float32(1)
    root_half = np.float32(math.sqrt(0.5))
    for i in range(begin, end):
        boxes[i, 0] = boxes[i, 1] = boxes[i, 2] = boxes[i, 3] = 0
        # Conditions are written so that NaN fails them. The cheapest one comes first: of Gaussians
        # that are too transparent to be drawn, nothing else is read.
        if not opacities[i] >= MIN_ALPHA:
            continue
        x, y, z = _apply_matrix(
            view, means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        )
        if not (z > near and z < np.inf):
            continue
        tan_x, tan_y = x * (one / z), y * (one / z)
        quat, _ = normalize_quat(quats, i)
        axes = _scale_columns(_multiply(view, rotate_by_quat(quat)), scales, i)
        flat = _flatten(axes, _compute_jacobian(fx, fy, tan_x, tan_y, one / z, limits))

        # The determinant of F Fᵀ + blur is summed from squares: nothing cancels, however thin
        # the splat is. In double precision nothing overflows either.
        a0, a1, a2 = np.float64(flat[0]), np.float64(flat[1]), np.float64(flat[2])
        b0, b1, b2 = np.float64(flat[3]), np.float64(flat[4]), np.float64(flat[5])
        aa = a0 * a0 + a1 * a1 + a2 * a2
        bb = b0 * b0 + b1 * b1 + b2 * b2
        ab = a0 * b0 + a1 * b1 + a2 * b2
        c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        determinant = c0 * c0 + c1 * c1 + c2 * c2 + blur * (aa + bb) + blur * blur
        if not determinant < np.inf:
            continue
        deviation_x = np.float32(math.sqrt(aa + blur))
        deviation_y = np.float32(math.sqrt(bb + blur))
        opacity = opacities[i]
        if factors is not None:
            factors[i] = math.sqrt((c0 * c0 + c1 * c1 + c2 * c2) / determinant)
            opacity *= factors[i]
            if not opacity >= MIN_ALPHA:
                continue

        # Alpha is opacity exp(-r² / 2) at r standard deviations; it reaches MIN_ALPHA at `sigmas`,
        # to which a margin for rounding is added, so that no pixel of that alpha is left out. The
        # box of an ellipse is as wide as the deviations along x and y.
        center_x, center_y = fx * tan_x + cx, fy * tan_y + cy
        sigmas = math.sqrt(np.float32(2) * math.log(opacity / MIN_ALPHA)) + np.float32(1e-3)
        radius_x, radius_y = sigmas * deviation_x, sigmas * deviation_y
        if not (abs(center_x) + radius_x < np.inf and abs(center_y) + radius_y < np.inf):
            continue
        # The centre of pixel j is j + 0.5. The sides are cut to the image before they become whole
        # numbers: those of a splat of scale 1e17, which a scene may have, fit in none.
        left = max(np.ceil(center_x - radius_x - half), zero)
        right = min(np.floor(center_x + radius_x + half), width)
        top = max(np.ceil(center_y - radius_y - half), zero)
        bottom = min(np.floor(center_y + radius_y + half), height)
        if not (left < right and top < bottom):
            continue
        boxes[i, 0], boxes[i, 1] = np.int32(left), np.int32(right)
        boxes[i, 2], boxes[i, 3] = np.int32(top), np.int32(bottom)
        # Cholesky factor of half the inverse covariance: alpha is opacity exp(-(s² + t²)), with
        # s = u x + v y and t = w y.
        u = root_half * deviation_y / np.float32(math.sqrt(determinant))
        splats[i, X], splats[i, Y] = center_x, center_y
        splats[i, U] = u
        splats[i, V] = -u * np.float32(ab / (bb + blur))
        splats[i, W] = root_half / deviation_y
        splats[i, DEPTH] = z

        direction, _ = _compute_direction(center, means, i)
        _evaluate_basis(direction, basis)
        for channel in range(3):
            color = half
            for k in range(len(basis)):
                color += basis[k] * sh[i, k, channel]
            splats[i, RED + channel] = max(color, zero)


@njit(fastmath={"contract"}, error_model="numpy")
def _compensation_backward(flat, blur, q):
    """Compute the gradient of the flattened axes from that of log sqrt(P / D).

    P is the squared area that they span, D the determinant with the blur.
    """
    a0, a1, a2 = np.float64(flat[0]), np.float64(flat[1]), np.float64(flat[2])
    b0, b1, b2 = np.float64(flat[3]), np.float64(flat[4]), np.float64(flat[5])
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    squares = a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2
    area = c0 * c0 + c1 * c1 + c2 * c2
    added = blur * squares + blur * blur
    of_area = q * added / (area * (area + added))
    of_squares = q * blur / (area + added)
    return (
        np.float32(of_area * (b1 * c2 - b2 * c1) - of_squares * a0),
        np.float32(of_area * (b2 * c0 - b0 * c2) - of_squares * a1),
        np.float32(of_area * (b0 * c1 - b1 * c0) - of_squares * a2),
        np.float32(of_area * (c1 * a2 - c2 * a1) - of_squares * b0),
        np.float32(of_area * (c2 * a0 - c0 * a2) - of_squares * b1),
        np.float32(of_area * (c0 * a1 - c1 * a0) - of_squares * b2),
    )


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def project_backward(
    begin, end, gaussians, pinhole, factors, splats, slot_start, gradients, written, d_gaussians
):
    """Write gradients of the Gaussians begin..end to `d_gaussians` from those of their entries.

    A Gaussian has an entry in the list of each tile that it touches. Those of Gaussian i have the
    slots slot_start[i] to slot_start[i + 1] of gradients [slots, 10], which count where `written`.
    factors and splats are those that `project_splats` wrote. `d_gaussians` are zero before, and
    stay zero for Gaussians without a written slot.
    """
    means, quats, scales, opacities, sh = gaussians
    d_means, d_quats, d_scales, d_opacities, d_sh = d_gaussians
    view = pinhole.rotation
    center = pinhole.center
    from_view = _transpose(view)
    fx, fy = pinhole.intrinsics[0], pinhole.intrinsics[1]
    limits = _compute_tangent_limits(pinhole)
    one = np.float32(1)
    two = np.float32(2)
    four = np.float32(4)
    sums = np.empty(NUM_GRADIENT_COLUMNS, np.float32)
    basis = np.empty(sh.shape[1], np.float32)
    d_basis = np.empty(sh.shape[1], np.float32)
    for i in range(begin, end):
        any_written = False
        sums[:] = 0
        for slot in range(slot_start[i], slot_start[i + 1]):
            if written[slot]:
                any_written = True
                for column in range(NUM_GRADIENT_COLUMNS):
                    sums[column] += gradients[slot, column]
        if not any_written:
            continue
        # SUM is alpha times its gradient, and alpha is proportional to the opacity.
        d_opacities[i] = sums[SUM] / opacities[i]

        # Colour, which is cut off at zero
        direction, inverse_distance = _compute_direction(center, means, i)
        _evaluate_basis(direction, basis)
        d_basis[:] = 0
        for channel in range(3):
            if splats[i, RED + channel] > 0:
                d_color = sums[SUM_RED + channel]
                for k in range(len(basis)):
                    d_sh[i, k, channel] = d_color * basis[k]
                    d_basis[k] += d_color * sh[i, k, channel]
        # Through the direction, the mean: only the part across the viewing ray turns it.
        turn = _basis_backward(direction, d_basis)
        radial = direction[0] * turn[0] + direction[1] * turn[1] + direction[2] * turn[2]

        x, y, z = _apply_matrix(
            view, means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        )
        inverse_z = one / z
        tan_x, tan_y = x * inverse_z, y * inverse_z
        quat, unit_factor = normalize_quat(quats, i)
        rotation = _multiply(view, rotate_by_quat(quat))
        axes = _scale_columns(rotation, scales, i)
        jacobian = _compute_jacobian(fx, fy, tan_x, tan_y, inverse_z, limits)
        flat = _flatten(axes, jacobian)

        # dL/dΣ = 2 Uᵀ Q U with Q = [[ss, st], [st, tt]], and Σ = F Fᵀ: dL/dF = 4 Uᵀ Q (U F).
        u, v, w = splats[i, U], splats[i, V], splats[i, W]
        ss, st, tt = sums[SUM_SS], sums[SUM_ST], sums[SUM_TT]
        s0 = u * flat[0] + v * flat[3]
        s1 = u * flat[1] + v * flat[4]
        s2 = u * flat[2] + v * flat[5]
        t0, t1, t2 = w * flat[3], w * flat[4], w * flat[5]
        a0, a1, a2 = ss * s0 + st * t0, ss * s1 + st * t1, ss * s2 + st * t2
        b0, b1, b2 = st * s0 + tt * t0, st * s1 + tt * t1, st * s2 + tt * t2
        d_x0, d_x1, d_x2 = four * u * a0, four * u * a1, four * u * a2
        d_y0 = four * (v * a0 + w * b0)
        d_y1 = four * (v * a1 + w * b1)
        d_y2 = four * (v * a2 + w * b2)
        if factors is not None:
            more = _compensation_backward(flat, pinhole.blur, sums[SUM])
            d_x0, d_x1, d_x2 = d_x0 + more[0], d_x1 + more[1], d_x2 + more[2]
            d_y0, d_y1, d_y2 = d_y0 + more[3], d_y1 + more[4], d_y2 + more[5]

        # F = J axes
        xx, xz, yy, yz = jacobian
        d_xx = d_x0 * axes[0] + d_x1 * axes[1] + d_x2 * axes[2]
        d_xz = d_x0 * axes[6] + d_x1 * axes[7] + d_x2 * axes[8]
        d_yy = d_y0 * axes[3] + d_y1 * axes[4] + d_y2 * axes[5]
        d_yz = d_y0 * axes[6] + d_y1 * axes[7] + d_y2 * axes[8]
        d_axes = (
            xx * d_x0,
            xx * d_x1,
            xx * d_x2,
            yy * d_y0,
            yy * d_y1,
            yy * d_y2,
            xz * d_x0 + yz * d_y0,
            xz * d_x1 + yz * d_y1,
            xz * d_x2 + yz * d_y2,
        )

        # axes = rotation diag(scales), rotation = view R(quat)
        for k in range(3):
            d_scales[i, k] = (
                d_axes[k] * rotation[k]
                + d_axes[3 + k] * rotation[3 + k]
                + d_axes[6 + k] * rotation[6 + k]
            )
        d_rotation = _multiply(from_view, _scale_columns(d_axes, scales, i))
        d_quat = _rotation_backward(quat, d_rotation)
        # The rotation does not depend on the length of the quaternion, so that the gradient has no
        # part along it.
        along = quat[0] * d_quat[0] + quat[1] * d_quat[1]
        along = along + quat[2] * d_quat[2] + quat[3] * d_quat[3]
        for k in range(4):
            d_quats[i, k] = (d_quat[k] - quat[k] * along) * unit_factor

        # J and the centre of the splat depend on the mean. A clamped tangent does not.
        d_tan_x = two * fx * u * sums[SUM_S]
        d_tan_y = two * fy * (v * sums[SUM_S] + w * sums[SUM_T])
        if limits[0] <= tan_x <= limits[1]:
            d_tan_x -= d_xz * xx
        if limits[2] <= tan_y <= limits[3]:
            d_tan_y -= d_yz * yy
        d_z = sums[SUM_DEPTH] - (d_xx * xx + d_xz * xz + d_yy * yy + d_yz * yz) * inverse_z
        d_z -= (d_tan_x * tan_x + d_tan_y * tan_y) * inverse_z
        d_mean = _apply_matrix(from_view, d_tan_x * inverse_z, d_tan_y * inverse_z, d_z)
        for k in range(3):
            d_means[i, k] = d_mean[k] + (turn[k] - direction[k] * radial) * inverse_distance
