"""A second score of a held-back photograph, without the errors of its own camera.

A pose that is off by a quarter of a pixel, or another exposure, costs a picture decibels that no
method can gain. So one pose (six numbers) and one gain for each channel of the target camera are
fitted to its photograph, outside of holes. Nothing of the scene changes. With the render R(p) at
the pose p, the photograph I, the pixels O that are counted outside of holes, and the gains g(p)
that bring R(p) nearest to I over O by least squares, the pose that is searched for is

    p = argmin  sum over O of  rho(blur(g(p) R(p)) - blur(I)),

where rho is quadratic up to `ROBUST` and grows linearly beyond it. Steps are those of Lucas and
Kanade: how an image changes with the pose follows from its gradient and its depth, so that a step
needs one render and not seven. It is taken only where it lowers the mean square, too, since the
score is a PSNR: that of g(p) R(p). The search is in a small image that samples the whole one, which
has to gain by the pose that is found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.metrics.unused_photographs import shrink_view
from gscompleter.numerics.geometry import sample_image
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians, Render, View

# Pixels of what follows are those of the image that the pose is fitted in, but for `HOLE_MARGIN`.
FIT_SIDE = 320
"""Longer side of the image that the pose is fitted in, at most; scores are of the whole one."""
MAX_MOVE = 4.0
"""Largest of the six numbers of a move, in pixels: poses are not searched for, but mended."""
MIN_STEP = 0.05
"""Change of each number of a move, in pixels, below which the fit has converged."""
MAX_NEWTON_STEPS = 10
"""Most Gauss-Newton steps for each blur."""
BLURS = (6.0, 1.5)
"""Standard deviations of the blur in pixels, one after the other, so that edges that lie beside
their place pull."""
SHARES = (1.0, 0.5, 0.25)
"""Shares of a step that are tried until one lowers the mean square."""
ROBUST = 0.03
"""Error of a colour in [0, 1] from which on its loss grows linearly, as in that of Huber."""
HOLE_MARGIN = 2
"""Pixels of the whole photograph around holes that do not count, where invented and photographed
colours mix. A move of `MAX_MOVE`, and the blur, carry invented colours farther. That is allowed:
each step has to lower the error of all pixels that count, most of which lie far from any hole."""
MIN_POSE_PIXELS = 500
"""Fewest pixels, of the image that a pose is fitted in, that determine it."""

PixelValues = Float[np.ndarray, "h w 3"]
Move = Float[np.ndarray, "6"]
"""Rotation about x, y, z and shift along them, in camera axes.

In pixels along x: a rotation by one is 1 / `focal_x` in radians, and a shift by one is what moves a
point at the median depth of the scene by a pixel. Moves are small, so that their numbers add.
"""
FocalLengths = tuple[float, float]
"""Along x and y, in pixels. They differ where pixels are not square."""


@dataclass(frozen=True)
class MovedPicture:
    """The scene after a move of the camera."""

    image: PixelValues
    points: Float[np.ndarray, "h w 3"]
    """What each pixel shows, in camera axes and scene units; at the median depth where it shows
    nothing."""


Draw = Callable[[Move], MovedPicture]
"""Renders the scene after a move."""


@dataclass(frozen=True)
class FittedQuality:
    """Scores in dB after one pose and one gain of the target camera were fitted."""

    psnr: float
    """PSNR of the whole image."""
    observed_psnr: float
    """PSNR outside of holes."""
    moved: float
    """Length of the six numbers of the move, in pixels of an image of at most `FIT_SIDE`."""
    gain: float
    """Mean of the factors by which the channels of the render were multiplied."""


def measure_fitted(
    scene: Gaussians, target: View, holes: Bool[Tensor, "h w"], renderer: Renderer
) -> FittedQuality | None:
    """Fit the camera and the exposure of a target to its photograph, and score the scene there.

    `holes` is where the scene was empty before it was completed. None if fewer than
    `MIN_POSE_PIXELS` of the image that the pose is fitted in lie outside.
    """
    observed = ~dilate(holes, HOLE_MARGIN) & target.valid_mask
    # The pose is fitted in a small image, since each step renders one; what counts there is what
    # holes, their margin and masks leave of the photograph.
    small = shrink_view(replace(target, ignore_mask=~observed), FIT_SIDE)
    small = replace(small, camera=sample_image(small.camera, target.camera))
    counted = small.valid_mask.cpu().numpy()
    if counted.sum() < MIN_POSE_PIXELS:
        return None
    start = renderer.render(scene, small.camera)
    median_depth = measure_depth(start, small.valid_mask)
    focals = (float(small.camera.K[0, 0]), float(small.camera.K[1, 1]))
    unit = median_depth / focals[0]
    # From world axes to those of the camera, in which moves are made.
    rays = small.camera.z_rays().double().cpu().numpy()
    rays = rays @ small.camera.c2w[:3, :3].double().cpu().numpy()

    def read_picture(render: Render) -> MovedPicture:
        shown = render.depth_map()
        depth = shown.depth.where(shown.valid, median_depth).double().cpu().numpy()
        return MovedPicture(clamp_image(render), rays * depth[..., None])

    def draw(move: Move) -> MovedPicture:
        camera = move_camera_by(small.camera, move, unit)
        return read_picture(renderer.render(scene, camera))

    first = read_picture(start)
    move = fit_move(draw, first, small.image.cpu().numpy(), counted, median_depth, focals)
    pose = move_camera_by(small.camera, move, unit).c2w

    truth = target.image.cpu().numpy()
    observed_pixels = observed.cpu().numpy()
    image = clamp_image(renderer.render(scene, replace(target.camera, c2w=pose)))
    # A small image does not show all that the whole one does.
    if move.any():
        unmoved = clamp_image(renderer.render(scene, target.camera))
        loss = measure_loss(image, truth, observed_pixels)
        if measure_loss(unmoved, truth, observed_pixels) <= loss:
            image = unmoved
            move = np.zeros(6)
    gains = fit_gains(image, truth, observed_pixels)
    fitted = torch.from_numpy(np.clip(image * gains, 0, 1)).to(target.image)
    # Scored are the pixels of the scores without a fit, with the margin around holes.
    whole = compute_masked_psnr(fitted, target.image, target.valid_mask)
    outside = compute_masked_psnr(fitted, target.image, ~holes & target.valid_mask)
    # At least `MIN_POSE_PIXELS` count.
    assert whole is not None
    assert outside is not None
    return FittedQuality(
        whole,
        outside,
        float(np.linalg.norm(move)),
        float(gains.mean()),
    )


def clamp_image(render: Render) -> PixelValues:
    """Clamp the colours of a render to [0, 1]."""
    return np.asarray(render.image.clamp(0, 1).cpu().numpy(), np.float64)


def measure_depth(render: Render, where: Bool[Tensor, "h w"]) -> float:
    """Measure the median z-depth over `where` in scene units; 1 if the scene covers none of it."""
    depths = render.depth_map()
    seen = where & depths.valid
    return float(depths.depth[seen].median()) if seen.any() else 1.0


def move_camera_by(camera: Camera, move: Move, unit: float) -> Camera:
    """Move a camera; `unit` is the shift, in scene units, that is a pixel at the median depth."""
    pose = camera.c2w.double().cpu().numpy().copy()
    pose[:3, 3] += pose[:3, :3] @ (move[3:] * unit)
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(move[:3] / float(camera.K[0, 0]))[0]
    return replace(camera, c2w=torch.from_numpy(pose).to(camera.c2w))


def fit_move(
    draw: Draw,
    first: MovedPicture,
    truth: PixelValues,
    counted: Bool[np.ndarray, "h w"],
    median_depth: float,
    focals: FocalLengths,
) -> Move:
    """Fit the move, from wide to narrow blur; zero if the picture is no nearer to the truth.

    `first` is the picture before any move. `median_depth` is in scene units.
    """
    no_move = np.zeros(6)
    move = no_move
    picture = first
    for sigma in BLURS:
        move, picture = fit_blurred(
            draw, move, picture, truth, counted, sigma, median_depth=median_depth, focals=focals
        )
    before, after = (measure_loss(each.image, truth, counted) for each in (first, picture))
    return move if after < before else no_move


def fit_blurred(
    draw: Draw,
    move: Move,
    picture: MovedPicture,
    truth: PixelValues,
    counted: Bool[np.ndarray, "h w"],
    sigma: float,
    *,
    median_depth: float,
    focals: FocalLengths,
) -> tuple[Move, MovedPicture]:
    """Fit the move to images blurred by `sigma` pixels, by Gauss-Newton steps with robust weights.

    It begins at `move`, after which the scene is `picture`, and returns both as they are at the
    end. The gains are fitted anew before each step, to sharp images, and constant within it.
    """
    wanted = blur(truth, sigma)

    def compute_residuals(
        image: PixelValues, gains: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "n"]:
        return (blur(image, sigma) * gains - wanted)[counted].ravel()

    for _ in range(MAX_NEWTON_STEPS):
        gains = fit_gains(picture.image, truth, counted)
        residuals = compute_residuals(picture.image, gains)
        jacobian = compute_move_jacobian(
            blur(picture.image, sigma), picture.points, median_depth, focals
        )
        jacobian = (jacobian * gains[:, None])[counted].reshape(-1, 6)
        # Weights of the loss of Huber: errors beyond `ROBUST` pull no harder than one of its size.
        weighted = jacobian / np.maximum(np.abs(residuals), ROBUST)[:, None]
        # A little damping, where two of the numbers act alike, as a turn and a shift do. It only
        # shortens steps, each of which is tested.
        normal = weighted.T @ jacobian
        normal += (1e-4 * np.trace(normal) + 1e-12) * np.eye(6)
        change = -np.linalg.solve(normal, weighted.T @ residuals)

        loss = np.square(residuals).mean()
        for share in SHARES:
            following = np.clip(move + share * change, -MAX_MOVE, MAX_MOVE)
            moved = draw(following)
            gains = fit_gains(moved.image, truth, counted)
            if np.square(compute_residuals(moved.image, gains)).mean() < loss:
                break
        else:
            return move, picture
        is_done = np.abs(following - move).max() < MIN_STEP
        move = following
        picture = moved
        if is_done:
            break
    return move, picture


def compute_move_jacobian(
    image: PixelValues,
    points: Float[np.ndarray, "h w 3"],
    median_depth: float,
    focals: FocalLengths,
) -> Float[np.ndarray, "h w 3 6"]:
    """Compute the derivatives of each colour by the six numbers of a move.

    `points` are what the pixels show, in camera axes. As the camera turns by r and shifts by s, a
    point X goes to X - r x X - s there, and its pixel by du; the colour at a fixed pixel changes by
    -gradient · du.
    """
    focal_x, focal_y = focals
    x, y, z = np.moveaxis(points, -1, 0)
    # r x X + s for each number: -1 times the motion of X.
    across = np.stack(
        [
            # Rotations about x, y and z, by 1 / focal_x radians each.
            np.stack([np.zeros_like(z), -z, y], axis=-1) / focal_x,
            np.stack([z, np.zeros_like(z), -x], axis=-1) / focal_x,
            np.stack([-y, x, np.zeros_like(z)], axis=-1) / focal_x,
            # Shifts along them, by the unit of `move_camera_by`.
            *(np.broadcast_to(axis * median_depth / focal_x, points.shape) for axis in np.eye(3)),
        ],
        axis=-1,
    )
    # The pixel is (focal_x * x, focal_y * y) / z up to a constant: du by the quotient rule.
    moved_x = -focal_x * (across[..., 0, :] - (x / z)[..., None] * across[..., 2, :]) / z[..., None]
    moved_y = -focal_y * (across[..., 1, :] - (y / z)[..., None] * across[..., 2, :]) / z[..., None]
    down, right = np.gradient(image, axis=(0, 1))
    return -(right[..., None] * moved_x[..., None, :] + down[..., None] * moved_y[..., None, :])


def measure_loss(image: PixelValues, truth: PixelValues, counted: Bool[np.ndarray, "h w"]) -> float:
    """Measure the mean squared error over counted pixels, after the best gains."""
    gains = fit_gains(image, truth, counted)
    return float(np.square(image * gains - truth)[counted].mean())


def fit_gains(
    image: PixelValues, truth: PixelValues, counted: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "3"]:
    """Fit the factor of each channel of `image` by least squares; 1 where it is black."""
    seen = image[counted]
    energy = (seen * seen).sum(axis=0)
    products = (seen * truth[counted]).sum(axis=0)
    return np.where(energy > 0, products / np.maximum(energy, 1e-12), 1.0)


def blur(image: PixelValues, sigma: float) -> PixelValues:
    """Blur an image by a Gaussian of `sigma` pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float64)
