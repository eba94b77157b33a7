"""Refined cameras of photographs whose given ones contradict the features that they share.

Poses of phones, SLAM and drives are off by a fraction of a pixel or more, which blurs whatever is
made from several photographs. The photographs are refined together (`refining_process`), those of
targets too: refining one pair alone moves the scene against the frame of everything else. Of very
many, `choose_known` takes some far apart, and the others keep their poses. A bundle adjustment
leaves the frame of the scene free, so a similarity moves its result into the given one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.data.cameras import Poses
from gscompleter.data.frame import MASKS
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.placing import write_known_copies
from gscompleter.data.sfm.poses import COPIES_FOLDER, require_pycolmap, run_colmap
from gscompleter.numerics.geometry import compute_spacing
from gscompleter.numerics.two_views import ERROR_SIDE, find_near_pairs
from gscompleter.types import Camera

REFINING_PROCESS = "gscompleter.data.sfm.refining_process"
"""Module that is run as a process of its own, as COLMAP aborts its process on some errors."""
MIN_REFINED = 3
"""Fewest photographs that are refined: two cannot hold the frame of the scene."""
NUM_MATCHED = 8
"""Photographs near each one, of similar direction, that it is matched with."""
POSITION_SIGMA = 0.1
"""Standard deviation of a given camera centre, in steps between cameras."""
MAX_ERROR_SHARE = 0.8
"""Refined poses are accepted if their error is below this share of the error of given ones."""


@dataclass(frozen=True)
class PoseRefinement:
    """What a refinement of poses did.

    Errors are those of the given and the refined poses: median distances, from their epipolar
    lines, of matches that the refinement did not use. They are in pixels of an image whose shorter
    side has `ERROR_SIDE`.
    """

    photographs: int
    """Number of photographs that were refined together."""
    given_error: float
    refined_error: float
    moved: float
    """Median move of a camera centre, in steps between neighbouring cameras."""
    splat_given: float | None = None
    """Mean PSNR in dB of a given splat against the photographs at their given poses; None without
    a splat."""
    splat_refined: float | None = None
    """The same at the refined poses."""

    @property
    def is_contradicted_by_splat(self) -> bool:
        """True if a given splat agrees less with the photographs at the refined poses."""
        if self.splat_given is None or self.splat_refined is None:
            return False
        return self.splat_refined < self.splat_given

    @property
    def is_accepted(self) -> bool:
        """True if matches that were kept back agree clearly better, and a given splat no worse."""
        agrees = self.refined_error < MAX_ERROR_SHARE * self.given_error
        return agrees and not self.is_contradicted_by_splat

    def describe(self) -> str:
        """Describe the refinement in a sentence for the user."""
        pixels = f"{self.given_error:.2f} px, and refined ones by {self.refined_error:.2f} px"
        agreement = ""
        if self.splat_given is not None and self.splat_refined is not None:
            agreement = (
                f"the splat agrees with the photographs at {self.splat_given:.2f} dB as given, and "
                f"at {self.splat_refined:.2f} dB as refined"
            )
        if self.is_contradicted_by_splat:
            return f"Given poses are kept, though they miss matches by {pixels}: {agreement}."
        if not self.is_accepted:
            return f"Given poses are kept: they miss matches by {pixels}."
        return (
            f"The poses of {self.photographs} photographs are refined: given ones miss matches "
            f"that were kept back by {pixels} (of {ERROR_SIDE}); "
            f"{agreement}{'; ' if agreement else ''}--no-refine-poses leaves them."
        )


def refine_poses(photographs: Photographs) -> tuple[Photographs, PoseRefinement | None]:
    """Refine the poses of photographs together; keep all unless matches agree clearly better.

    Returns the photographs in the given frame and scale, and what was done. That is None, and all
    poses are kept, if fewer than `MIN_REFINED` photographs can be refined, if most cameras share
    their place with another, or if no match was kept back that could compare the poses.

    Raises:
        InputError: pycolmap is missing, or COLMAP gave up.
    """
    require_pycolmap()
    with tempfile.TemporaryDirectory() as work:
        home = Path(work)
        copies, _ = write_known_copies(photographs, home)
        if len(copies) < MIN_REFINED:
            return photographs, None
        # Copies are named by the numbers of their photographs.
        numbers = [int(Path(copy.name).stem) for copy in copies]
        cameras = [photographs.camera(number) for number in numbers]
        step = compute_spacing(cameras)
        if step == 0:
            return photographs, None
        job = {
            "images": str(home / COPIES_FOLDER),
            "masks": str(home / MASKS),
            "model": str(home / "model"),
            "copies": [asdict(copy) for copy in copies],
            "pairs": pair_near(cameras),
            "position_sigma": POSITION_SIGMA * step,
        }
        result = run_colmap(REFINING_PROCESS, job, home, "Refining poses")

    given = np.stack([invert_pose_rows(copy.viewmat) for copy in copies])
    found = [pose is not None for pose in result["poses"]]
    if sum(found) < MIN_REFINED or result["given_error"] is None:
        return photographs, None
    # Photographs that COLMAP could not refine keep their poses.
    refined = given.copy()
    refined[found] = [pose for pose in result["poses"] if pose is not None]
    # From pixels of the copies, most of which have the size of the first.
    scale = ERROR_SIDE / min(copies[0].width, copies[0].height)
    moves = np.linalg.norm(refined[found][:, :3, 3] - given[found][:, :3, 3], axis=1)
    done = PoseRefinement(
        photographs=sum(found),
        given_error=result["given_error"] * scale,
        refined_error=result["refined_error"] * scale,
        moved=float(np.median(moves)) / step,
    )
    if not done.is_accepted:
        return photographs, done
    frames = list(photographs.frames)
    for number, pose in zip(numbers, refined, strict=True):
        pose[:3, 3] += photographs.origin  # cameras are relative to it, and frames are not
        frames[number] = replace(frames[number], c2w=pose)
    return replace(photographs, frames=tuple(frames)), done


def has_pycolmap() -> bool:
    """Return True if COLMAP is installed."""
    return find_spec("pycolmap") is not None


def pair_near(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Pair each camera with the `NUM_MATCHED` nearest in place and direction; i < j, sorted."""
    centers = torch.stack([camera.center for camera in cameras]).double().numpy()
    forward = torch.stack([camera.forward for camera in cameras]).double().numpy()
    return find_near_pairs(centers, forward, NUM_MATCHED)


def invert_pose_rows(viewmat: Sequence[Sequence[float]]) -> Float[np.ndarray, "4 4"]:
    """Return the camera-to-world matrix of the rows of a world-to-camera matrix [3, 4]."""
    return np.linalg.inv(np.vstack([viewmat, [0.0, 0.0, 0.0, 1.0]]))


def move_to_given_frame(refined: Poses, given: Poses) -> Poses:
    """Move refined cameras into the given frame, by the similarity that fits all of them.

    The rotation is fitted to their rotations, since the centres of a straight drive determine none
    about its own line; scale and shift are fitted to the centres. All are least squares and not the
    medians of `fit_pose_similarity`, as the poses of one bundle adjustment agree with each other.
    Both are camera-to-world, in the same order; two centres at least have to be apart.
    """
    # Orthogonal Procrustes: the rotation R with the largest sum of trace(givenᵀ R refined).
    covariance = np.einsum("nij,nkj->ik", given[:, :3, :3], refined[:, :3, :3])
    u, _, v = np.linalg.svd(covariance)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    middle = given[:, :3, 3].mean(axis=0)
    offsets = (refined[:, :3, 3] - refined[:, :3, 3].mean(axis=0)) @ rotation.T
    given_offsets = given[:, :3, 3] - middle
    scale = (given_offsets * offsets).sum() / (offsets * offsets).sum()

    result = refined.copy()
    result[:, :3, :3] = rotation @ refined[:, :3, :3]
    result[:, :3, 3] = scale * offsets + middle
    return result
