"""A second score of a held-back photograph, without the errors of its own camera.

A pose that is off by a quarter of a pixel, or another exposure, costs a picture decibels that no
method can gain. So one pose (six numbers) and one gain for each channel of the target camera are
fitted to its photograph, outside of holes. Nothing of the scene changes. With the render R(p) at
the pose p, the photograph I and the pixels O that are counted outside of holes,

    p, g = argmin  sum over O of  rho(blur(g R(p)) - blur(I)),

where rho is quadratic up to `ROBUST` and grows linearly beyond it. The score is the PSNR of g R(p).
Steps are those of Lucas and Kanade: how an image changes with the pose follows from its gradient
and its depth, so that a step needs one render and not seven.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.evaluation.metrics.image import MAX_PSNR, compute_masked_psnr
from gscompleter.evaluation.metrics.unused_photographs import shrink_view
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians, Render, View

FIT_SIDE = 320
"""Longer side of the image that the pose is fitted in, at most; scores are of the whole one."""
MAX_MOVE = 4.0
"""Largest rotation and shift along each axis, in pixels: poses are not searched for, but mended."""
MIN_STEP = 0.05
"""Largest change in pixels at which the fit has converged."""
MAX_NEWTON_STEPS = 10
"""Most steps of Gauss and Newton for each blur."""
BLURS = (6.0, 1.5)
"""Standard deviations of the blur in pixels, one after the other, so that edges that lie beside
their place pull."""
SHARES = (1.0, 0.5, 0.25)
"""Shares of a step that are tried until one helps."""
ROBUST = 0.03
"""Error of a colour from which on it pulls no more than linearly."""
HOLE_MARGIN = 2
"""Pixels around holes that do not count, since holes move with the camera."""
MIN_POSE_PIXELS = 500
"""Fewest pixels that determine a pose."""

PixelValues = Float[np.ndarray, "h w 3"]
Move = Float[np.ndarray, "6"]
"""Rotation about x, y, z and shift along them, in camera axes and pixels."""


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
    """Length of the rotation and shift, in pixels of an image of at most `FIT_SIDE`."""
    gain: float
    """Mean of the gains of the channels."""


def measure_fitted(
    scene: Gaussians, target: View, holes: Bool[Tensor, "h w"], renderer: Renderer
) -> FittedQuality | None:
    """Fit the camera and the exposure of a target to its photograph, and score the scene there.

    `holes` is where the scene was empty before it was completed. None if fewer than
    `MIN_POSE_PIXELS` lie outside.
    """
    observed = ~dilate(holes, HOLE_MARGIN) & target.valid_mask
    if observed.sum() < MIN_POSE_PIXELS:
        return None
    # In a small image, for the time of a dozen renders; what counts there is what holes, masks
    # and their margin leave of the photograph.
    small = shrink_view(replace(target, ignore_mask=~observed), FIT_SIDE)
    counted = small.valid_mask.cpu().numpy()
    start = renderer.render(scene, small.camera)
    median = measure_depth(start, small.valid_mask)
    focal = float(small.camera.K[0, 0])
    # In camera axes, where moves are made.
    rays = small.camera.z_rays().double().cpu().numpy()
    rays = rays @ small.camera.c2w[:3, :3].double().cpu().numpy()

    def read_picture(render: Render) -> MovedPicture:
        shown = render.depth_map()
        depth = shown.depth.where(shown.valid, median).double().cpu().numpy()
        return MovedPicture(clamp_image(render), rays * depth[..., None])

    def draw(move: Move) -> MovedPicture:
        camera = move_camera_by(small.camera, move, median / focal)
        return read_picture(renderer.render(scene, camera))

    first = read_picture(start)
    move = fit_move(draw, first, small.image.cpu().numpy(), counted, median, focal)
    pose = move_camera_by(small.camera, move, median / focal).c2w
    image = clamp_image(renderer.render(scene, replace(target.camera, c2w=pose)))
    gains = fit_gains(image, target.image.cpu().numpy(), observed.cpu().numpy())
    fitted = torch.from_numpy(np.clip(image * gains, 0, 1)).to(target.image)
    whole = compute_masked_psnr(fitted, target.image, target.valid_mask)
    outside = compute_masked_psnr(fitted, target.image, ~holes & target.valid_mask)
    assert outside is not None
    return FittedQuality(
        MAX_PSNR if whole is None else whole,
        outside,
        float(np.linalg.norm(move)),
        float(gains.mean()),
    )


def clamp_image(render: Render) -> PixelValues:
    """Clamp the colours of a render to [0, 1]."""
    return np.asarray(render.image.clamp(0, 1).cpu().numpy(), np.float64)


def measure_depth(render: Render, where: Bool[Tensor, "h w"]) -> float:
    """Measure the median depth of a render over the pixels of `where`, in scene units."""
    depths = render.depth_map()
    seen = where & depths.valid
    return float(depths.depth[seen].median()) if seen.any() else 1.0


def move_camera_by(camera: Camera, move: Move, unit: float) -> Camera:
    """Rotate and shift a camera; `unit` is the shift that is a pixel at the median depth."""
    pose = camera.c2w.double().cpu().numpy().copy()
    pose[:3, 3] += pose[:3, :3] @ (move[3:] * unit)
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(move[:3] / float(camera.K[0, 0]))[0]
    return replace(camera, c2w=torch.from_numpy(pose).to(camera.c2w))


def fit_move(
    draw: Draw,
    first: MovedPicture,
    truth: PixelValues,
    counted: Bool[np.ndarray, "h w"],
    median: float,
    focal: float,
) -> Move:
    """Fit the move, from wide to narrow blur; zero if the picture is no nearer to the truth.

    `first` is the picture before any move. `median` is the median depth in scene units, and `focal`
    the focal length in pixels.
    """
    still = np.zeros(6)
    move = still
    picture = first
    for sigma in BLURS:
        move, picture = fit_blurred(
            draw, move, picture, truth, counted, sigma, median=median, focal=focal
        )
    before, after = (measure_loss(each.image, truth, counted) for each in (first, picture))
    return move if after < before else still


def fit_blurred(
    draw: Draw,
    move: Move,
    picture: MovedPicture,
    truth: PixelValues,
    counted: Bool[np.ndarray, "h w"],
    sigma: float,
    *,
    median: float,
    focal: float,
) -> tuple[Move, MovedPicture]:
    """Fit the move to blurred images, by steps of Gauss and Newton with robust weights.

    `picture` is the scene after `move`, from which it begins; returns both at the end.
    """
    wanted = blur(truth, sigma)

    def compute_residuals(
        image: PixelValues, gains: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "n"]:
        return (blur(image, sigma) * gains - wanted)[counted].ravel()

    for _ in range(MAX_NEWTON_STEPS):
        gains = fit_gains(picture.image, truth, counted)
        residuals = compute_residuals(picture.image, gains)
        slopes = compute_slopes(blur(picture.image, sigma), picture.points, median, focal)
        slopes = (slopes * gains[:, None])[counted].reshape(-1, 6)
        weighted = slopes / np.maximum(np.abs(residuals), ROBUST)[:, None]
        # A little damping, where two of the numbers act alike, as a turn and a shift do.
        normal = weighted.T @ slopes
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


def compute_slopes(
    image: PixelValues, points: Float[np.ndarray, "h w 3"], median: float, focal: float
) -> Float[np.ndarray, "h w 3 6"]:
    """Compute how each colour changes with each number of a move.

    A point X in camera axes goes to X - r x X - s as the camera turns by r and shifts by s, and so
    its pixel by du, in pixels; the colour at a fixed pixel changes by -gradient · du.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    across = np.stack(
        [
            # r x X for unit turns about x, y and z, a pixel each at the focal length
            np.stack([np.zeros_like(z), -z, y], axis=-1) / focal,
            np.stack([z, np.zeros_like(z), -x], axis=-1) / focal,
            np.stack([-y, x, np.zeros_like(z)], axis=-1) / focal,
            *(np.broadcast_to(axis * median / focal, points.shape) for axis in np.eye(3)),
        ],
        axis=-1,
    )
    # The pixel is focal * (x, y) / z: by the quotient rule, with -across for the motion.
    moved_x = -focal * (across[..., 0, :] - (x / z)[..., None] * across[..., 2, :]) / z[..., None]
    moved_y = -focal * (across[..., 1, :] - (y / z)[..., None] * across[..., 2, :]) / z[..., None]
    down, right = np.gradient(image, axis=(0, 1))
    return -(right[..., None] * moved_x[..., None, :] + down[..., None] * moved_y[..., None, :])


def measure_loss(image: PixelValues, truth: PixelValues, counted: Bool[np.ndarray, "h w"]) -> float:
    """Measure the squared error outside of holes after the best gains."""
    gains = fit_gains(image, truth, counted)
    return float(np.square(image * gains - truth)[counted].mean())


def fit_gains(
    image: PixelValues, truth: PixelValues, counted: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "3"]:
    """Fit the gain of each channel by least squares; 1 for a black one."""
    seen = image[counted]
    energy = (seen * seen).sum(axis=0)
    products = (seen * truth[counted]).sum(axis=0)
    return np.where(energy > 0, products / np.maximum(energy, 1e-12), 1.0)


def blur(image: PixelValues, sigma: float) -> PixelValues:
    """Blur an image."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float64)
