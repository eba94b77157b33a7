"""The kernels compiled before they are needed: each part that has some works once on a tiny scene.

numba compiles one kernel at a time in a process, and a completion would meet them one after the
other. Parts are rehearsed in several processes, and find in the cache what another compiled.
The scene is a textured wall, parallel to the images of cameras that stand side by side.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import torch

from gscompleter.garbage import staying
from gscompleter.generators import Request, load_generator
from gscompleter.interpolation import smoothed
from gscompleter.kernels.compiled import is_compiled, note_compiled
from gscompleter.progress import expecting, stage
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.threads import threads
from gscompleter.types import Camera, Gaussians, Render, SceneContext, View, observed, sh_from_rgb

SIDE = 64
"""Pixels of an image."""
SHIFT = 6
"""Pixels by which the wall moves from one image to the next."""
DEPTH = 2.0
"""Of the wall, in baselines."""


def photographs() -> list[View]:
    """The wall as two cameras see it."""
    noise = torch.rand(SIDE, SIDE + SHIFT, 3, generator=torch.Generator().manual_seed(0))
    wall = smoothed(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    return [View(wall[:, SHIFT * i :][:, :SIDE].contiguous(), camera_at(i)) for i in range(2)]


def camera_at(place: int) -> Camera:
    """A camera so many baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    focal = SHIFT * DEPTH
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    return Camera(c2w, K, SIDE, SIDE, near=DEPTH / 2, far=DEPTH * 4)


def render_with(renderer: str) -> None:
    """Draw some Gaussians in all the ways there are, and ask for gradients."""
    drawing, camera, gaussians = load_renderer(renderer), camera_at(0), some_gaussians()
    frozen = drawing.freeze(gaussians, camera)
    opacities = gaussians.opacities.clone().requires_grad_()
    means = gaussians.means.clone().requires_grad_()
    moved = observed(means, gaussians.quats, gaussians.scales, opacities, gaussians.sh)
    frozen.composite(moved).image.sum().backward()
    frozen.plan(gaussians)(opacities).image.sum().backward()
    grey = torch.full((SIDE, SIDE, 3), 0.5)
    frozen.plan_colours(gaussians)(torch.rand(len(gaussians), 3), grey)
    depths = torch.full((len(gaussians),), DEPTH, requires_grad=True)
    everywhere = torch.ones(SIDE, SIDE, dtype=torch.bool)
    frozen.plan_depths(gaussians, everywhere)(depths).depth.sum().backward()
    frozen.extended(gaussians)


def fold_brought(_: str) -> None:
    """Fit the looks of Gaussians to a scene that was brought."""
    gaussians = some_gaussians()
    looks = gaussians.opacities.clone().requires_grad_(), gaussians.sh.clone().requires_grad_()
    frozen = load_renderer("cpu").freeze(gaussians, camera_at(0))
    frozen.plan_appearance(gaussians)(*looks).sum().backward()


def some_gaussians() -> Gaussians:
    """Four Gaussians on the wall."""
    means = torch.tensor([[x, y, DEPTH] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    quats, grey = torch.tensor([[1.0, 0, 0, 0]] * 4), sh_from_rgb(torch.full((4, 3), 0.5))
    return observed(means, quats, torch.full((4, 3), 0.1), torch.full((4,), 0.5), grey)


def reconstruct_with(reconstructor: str) -> None:
    """Make Gaussians of the two photographs."""
    load_reconstructor(reconstructor)(photographs())


def synthesize_with(generator: str) -> None:
    """Paint what a third camera sees, half of which is a hole."""
    views = photographs()
    depth, seen = torch.full((SIDE, SIDE), DEPTH), torch.ones(SIDE, SIDE)
    half = (torch.arange(SIDE) < SIDE // 2).expand(SIDE, SIDE).float()
    at_views = tuple(Render(view.image, depth, seen) for view in views)
    at_target = Render(views[1].image * half[..., None], depth * half, half)
    context = SceneContext(tuple(views), at_views, at_target)
    load_generator(generator).synthesize([Request(views[1], camera_at(2), context)])


BROUGHT = "brought"
"""The part that only scenes need that are brought."""
PARTS: dict[str, Callable[[str], None]] = {
    "cpu": render_with,
    BROUGHT: fold_brought,
    "warp-inpaint": synthesize_with,
    "plane-sweep": reconstruct_with,
}
"""The parts that have kernels, and how each is rehearsed. The last draws, too, and finds what the
first compiled."""
DRAWING = "cpu", BROUGHT
"""Parts that one process rehearses while another has the rest, which takes about as long."""

APART = f"""
import sys
from gscompleter.garbage import staying
with staying():
    from {__name__} import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""What a process runs that rehearses parts; numba compiles a tenth faster in it."""

COMPILING = "compiling kernels for this machine, once"
"""What it is called while it goes on."""
SECONDS = 30
"""About what all of them take together on one core."""


def compile_kernels(names: Sequence[str]) -> float | None:
    """Compile what the parts of these names need, where it is not there yet.

    Returns:
        The seconds that it took, or None where nothing was to be done.

    Raises:
        subprocess.CalledProcessError: where a process fails; it has said why.
    """
    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    own, *others = shares_of(missing, threads())
    expected = SECONDS * len(missing) / len(PARTS) / (1 + len(others))
    start = time.perf_counter()
    with expecting([(COMPILING, expected)]), stage(COMPILING), rehearsed_apart(others), staying():
        for name in own:
            rehearse(name)
    return time.perf_counter() - start


def shares_of(names: Sequence[str], count: int) -> list[list[str]]:
    """What each of at most two, and at most `count`, processes rehearses."""
    drawing = [name for name in names if name in DRAWING]
    rest = [name for name in names if name not in DRAWING]
    return [share for share in (drawing, rest) if share] if count > 1 else [list(names)]


@contextmanager
def rehearsed_apart(shares: Sequence[Sequence[str]]) -> Iterator[None]:
    """Rehearse each share of parts in a process of its own, meanwhile."""
    commands = [[sys.executable, "-c", APART, *share] for share in shares]
    with ExitStack() as stack:
        processes = []
        for command in commands:
            processes.append(subprocess.Popen(command, stdin=subprocess.DEVNULL))
            stack.callback(processes[-1].wait)
            stack.callback(processes[-1].kill)
        yield
        for process in processes:
            if process.wait() != 0:
                raise subprocess.CalledProcessError(process.returncode, process.args)


def rehearse(name: str) -> None:
    """Rehearse a part in this process, and remember that its kernels are compiled."""
    PARTS[name](name)
    note_compiled(name)
