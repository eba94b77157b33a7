"""Measurements that need a GPU; writes docs/gpu.md and docs/gpu.json.

    make gpu
    PYTHONPATH=src:tests python benchmarks/gpu.py [--only agreement stages ...]

It needs torch with CUDA, gsplat and the test dependencies. Data are synthetic rooms and weights are
random, so nothing is downloaded.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from bench_models import MODELS, model, repeated
from bench_pe_field import transformer
from bench_render import median_seconds
from gpu_report import Part, Row, main, shortened, tried
from gscompleter import Gaussians, GSCompleter, View, load_renderer
from gscompleter.generators.diffusion.pe_field import PEField
from gscompleter.render import FrozenView, Renderer
from gscompleter.render.reference import ReferenceView
from gscompleter.types import Camera, SceneContext, merge
from scenes import Room, camera_at, gaussians_of, view_of

ROOT = Path(__file__).resolve().parents[1]
NETWORKS = MODELS[1:]
"""Models with weights; the first of all is plane-sweep."""
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Bench:
    """Settings of all parts; small ones on a CPU are for tests of this file."""

    device: str = "cuda"
    """Device, also the name of the renderer."""
    sizes: tuple[tuple[int, int], ...] = ((256, 256), (256, 448))
    """Heights and widths of the images."""
    models: tuple[str, ...] = MODELS
    dtypes: tuple[str, ...] = tuple(DTYPES)
    repetitions: int = 5

    @property
    def renderer(self) -> Renderer:
        return load_renderer(self.device)

    def camera(self, x: float, size: tuple[int, int], yaw: float = 0.0) -> Camera:
        """Make a camera of `size` in the room, with the focal length of a square one."""
        height, width = size
        camera = camera_at(x, yaw=yaw, size=height)
        K = camera.K.clone()
        K[0, 2] = width / 2
        return replace(camera, K=K, width=width)

    def views(self, size: tuple[int, int]) -> list[View]:
        shots = [view_of(Room(), self.camera(x, size), i) for i, x in enumerate((-0.3, 0.1))]
        return [shot.to(self.device) for shot in shots]

    def target(self, size: tuple[int, int]) -> Camera:
        return self.camera(0.5, size, yaw=10).to(self.device)

    def scene(self, views: list[View]) -> Gaussians:
        return merge([gaussians_of(view.to("cpu")) for view in views]).to(self.device)


def built(bench: Bench) -> Iterator[Row]:
    """Measure the first render, for which gsplat compiles its kernels."""
    view = bench.views((64, 64))[0]
    scene = bench.scene([view])
    seconds = median_seconds(lambda: bench.renderer.render(scene, view.camera), 1, warm=False)
    yield Row("until the first picture", seconds, "s")


def tested(*arguments: str) -> Iterator[Row]:
    """Run pytest with these arguments; no passed test counts as a failure."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = done.stdout.strip().splitlines() or [shortened(done.stderr) or "no output"]
    for line in lines:
        if line.startswith(("FAILED", "ERROR")):
            yield Row("test", note=shortened(line), failed=True)
    whole = done.returncode == 0 and re.search(r"\d+ passed", lines[-1]) is not None
    yield Row(f"pytest {' '.join(arguments)}", note=lines[-1].strip("= "), failed=not whole)


def agreement(bench: Bench) -> Iterator[Row]:
    """Compare renders and gradients with those of the reference renderer on the CPU."""
    from test_render import CAMERA, PARAMETERS, REFERENCE, SCENES, gradients

    camera = CAMERA.to(bench.device)
    for name, scene in SCENES.items():
        there = scene.to(bench.device)
        ours, truth = bench.renderer.render(there, camera), REFERENCE.render(scene, CAMERA)
        for part in ("image", "alpha", "depth"):
            difference = (getattr(ours, part).cpu() - getattr(truth, part)).abs()
            yield Row(f"{name}: largest difference of {part}", difference.max().item())
        found, expected = gradients(bench.renderer, there, camera), gradients(REFERENCE, scene)
        for parameter in PARAMETERS:
            error = (found[parameter].cpu() - expected[parameter]).norm()
            relative = error / expected[parameter].norm().clamp_min(1e-12)
            yield Row(f"{name}: relative difference of gradients in {parameter}", relative.item())


def renderer(bench: Bench) -> Iterator[Row]:
    """Measure a step of registration and of refinement, with and without a frozen scene."""
    for size in bench.sizes:
        views = bench.views(size)
        context, camera = bench.scene(views), bench.target(size)
        new = bench.scene([view_of(Room(), camera.to("cpu"))])
        shown = f"{size[0]}x{size[1]}, {len(context):,} frozen and {len(new):,} new"
        plain = ReferenceView(bench.renderer, context, camera)
        frozen = bench.renderer.freeze(context, camera)
        for step, make in (("composite", composite_step), ("opacities", opacity_step)):
            anew = median_seconds(make(plain, new), bench.repetitions)
            ours = median_seconds(make(frozen, new), bench.repetitions)
            yield Row(f"{shown}: {step}, all anew", 1e3 * anew, "ms")
            yield Row(f"{shown}: {step}, frozen", 1e3 * ours, "ms", f"{anew / ours:.1f} times")


def composite_step(view: FrozenView, new: Gaussians) -> Callable[[], None]:

    def step() -> None:
        means = new.means.clone().requires_grad_()
        view.composite(replace(new, means=means)).image.sum().backward()

    return step


def opacity_step(view: FrozenView, new: Gaussians) -> Callable[[], None]:
    plan = view.plan(new)

    def step() -> None:
        opacities = new.opacities.clone().requires_grad_()
        plan(opacities).image.sum().backward()

    return step


def stages(bench: Bench) -> Iterator[Row]:
    """Measure the second completion of the room; the first one compiles kernels."""
    complete = GSCompleter(renderer=bench.renderer)
    for size in bench.sizes:
        views, target = bench.views(size), bench.target(size)
        complete(views, target)
        done = complete(views, target)
        for stage, seconds in done.seconds.items():
            yield Row(f"{size[0]}x{size[1]}: {stage}", seconds, "s")


def completions(bench: Bench) -> Iterator[Row]:
    """Complete with all models; with random weights only success and provenance are checked."""
    size = bench.sizes[0]
    views, target = bench.views(size), bench.target(size)

    def completed(name: str) -> Iterator[Row]:
        network, _ = model(name, bench.device)
        done = GSCompleter(reconstructor=network, renderer=bench.renderer)(views, target)
        added = int((done.scene.generated > 0).sum())
        finite = bool(done.scene.means.isfinite().all())
        if added != len(done.added) or not finite:
            raise RuntimeError(f"{added} marked of {len(done.added)} added, finite: {finite}")
        yield Row(name, done.seconds["total"], "s", f"{added:,} Gaussians added")

    for name in bench.models:
        yield from tried(name, lambda name=name: completed(name))


def models(bench: Bench) -> Iterator[Row]:
    """Measure two photographs through each network."""
    views = bench.views(bench.sizes[0])

    def passed(name: str, dtype: str) -> Iterator[Row]:
        network, _ = model(name, bench.device, DTYPES[dtype])
        found = repeated(network, views, bench.repetitions)
        peak = "" if found.peak_bytes is None else f"{found.peak_bytes / 2**30:.2f} GiB"
        yield Row(f"{name}, {dtype}", 1e3 * found.seconds, "ms", peak)

    for name in bench.models:
        if name in NETWORKS:
            for dtype in bench.dtypes:
                what = f"{name}, {dtype}"
                yield from tried(what, lambda n=name, d=dtype: passed(n, d))


def pe_field(bench: Bench, kontext: Callable[[str], Any] | None = None) -> Iterator[Row]:
    """Measure an image in four steps, with encoding and decoding."""
    size = bench.sizes[-1]
    views, target = bench.views(size), bench.target(size)
    scene = bench.scene(views)
    seen = tuple(bench.renderer.render(scene, view.camera) for view in views)
    context = SceneContext(tuple(views), seen, bench.renderer.render(scene, target))
    generator = PEField((kontext or random_kontext)(bench.device))

    def painted() -> None:
        generator.painted([generator.condition(views[1], target, context)], seed=0)

    seconds = median_seconds(painted, bench.repetitions)
    yield Row(f"{size[0]}x{size[1]}, {generator.steps} steps", seconds, "s")
    if bench.device == "cuda":
        peak = torch.cuda.max_memory_allocated() / 2**30
        yield Row("most memory that torch held", peak, "GiB")


def random_kontext(device: str) -> Any:
    """Build FLUX Kontext with random weights and an empty prompt."""
    from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, FluxKontextPipeline

    from bench_pe_field import BLOCKS, TEXT
    from gscompleter.generators.diffusion.kontext import Kontext, Prompt
    from gscompleter.generators.diffusion.placing import precision_on
    from gscompleter.generators.diffusion.rotary import with_per_head_positions

    dtype, levels = precision_on(device), 4
    vae = AutoencoderKL(
        block_out_channels=(128, 256, 512, 512),
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        layers_per_block=2,
        latent_channels=16,
        shift_factor=0.1159,
        scaling_factor=0.3611,
        use_quant_conv=False,
        use_post_quant_conv=False,
    )
    unused = dict.fromkeys(("text_encoder", "text_encoder_2", "tokenizer", "tokenizer_2"))
    pipeline = FluxKontextPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True, shift=3.0),
        vae=vae.to(device, dtype).eval(),
        transformer=with_per_head_positions(transformer(BLOCKS, device)),
        **unused,
    )
    tokens = torch.zeros(1, TEXT, 4096, device=device, dtype=dtype)
    pooled = torch.zeros(1, 768, device=device, dtype=dtype)
    return Kontext(pipeline, Prompt(tokens, pooled), device, dtype)


BENCH = Bench()
PARTS = {
    "build": Part("gsplat compiles", 270, lambda: built(BENCH)),
    "tests": Part("Tests", 90, lambda: tested("-m", "gpu"), needs="build"),
    "agreement": Part(
        "Agreement with the reference renderer", 60, lambda: agreement(BENCH), needs="build"
    ),
    "renderer": Part("Renderer, a step of optimisation", 60, lambda: renderer(BENCH), "build"),
    "stages": Part("Stages, embedded models", 120, lambda: stages(BENCH), needs="build"),
    "completions": Part("A completion with every Ψ", 120, lambda: completions(BENCH), "build"),
    "models": Part("Ψ, two photographs at 256x256", 90, lambda: models(BENCH)),
    "pe-field": Part("PE-Field, all of it", 120, lambda: pe_field(BENCH)),
}


def machine() -> dict[str, str]:
    """Describe the GPU and the versions; exit with code 2 if torch sees no GPU."""
    if not torch.cuda.is_available():
        print("make gpu needs a CUDA device, and torch sees none on this machine.", file=sys.stderr)
        raise SystemExit(2)
    major, minor = torch.cuda.get_device_capability()
    # gsplat compiles for this architecture only, which saves minutes.
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", f"{major}.{minor}")
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    driver = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split("\n")
    return {
        "device": torch.cuda.get_device_name(),
        "driver": driver[0].strip() or "unknown",
        "torch": f"{torch.__version__}, CUDA {torch.version.cuda}",
        "gsplat": installed("gsplat"),
        "diffusers": installed("diffusers"),
        "python": platform.python_version(),
        "date": date.today().isoformat(),
    }


def installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    main(PARTS, machine, __doc__ or "")
