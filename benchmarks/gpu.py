"""Measurements that need a GPU; writes docs/gpu.md and docs/gpu.json.

    make gpu
    bash benchmarks/gpu.sh [--only agreement stages ...] [--out FOLDER]

benchmarks/gpu.sh sets up what it needs: torch with CUDA, gsplat and the test dependencies. Data are
synthetic rooms and weights are random, so nothing is downloaded. The most valuable parts come
first, and the report is written after each of them. GPU_SIZES="64x64 64x80" measures images of
other sizes.
"""

from __future__ import annotations

import os
import platform
import re
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from torch.autograd import DeviceType

import tiny_diffusion
from bench_models import MODELS, load_model, measure_repeatedly
from bench_pe_field import build_transformer
from bench_render import measure_median_seconds, read_clock
from gpu_report import Part, Row, main, shorten, try_rows
from gscompleter import CompleterConfig, Gaussians, GSCompleter, View, load_renderer
from gscompleter.evaluation.baselines.optimization import OptimizationConfig, optimize
from gscompleter.evaluation.baselines.reggs import RegGSConfig, register_by_similarity
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators import GeneratorRequest, load_generator
from gscompleter.generators.patch_devices import PATCH_DEVICES
from gscompleter.generators.patch_rounds import (
    PatchRounds,
    RunRounds,
    run_with_kernels,
    run_with_tensors,
)
from gscompleter.generators.warp_inpaint import WarpInpaint
from gscompleter.models.diffusion.inpaint import DiffusersInpaint, Editor, get_size_rules
from gscompleter.models.diffusion.pe_field import PEField
from gscompleter.models.diffusion.placing import select_dtype
from gscompleter.models.tables import DEPTH_PREDICTORS
from gscompleter.models.weights.fetching import find_cached
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors.depth_predictors import load_depth_predictor
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.render.redraw import RedrawnScene
from gscompleter.system.timing import STAGE_PREFIX, STAGES
from gscompleter.types import Camera, GeneratorInput, Reconstruction, merge
from scenes import Room, camera_at, gaussians_of, photographed, view_of

ROOT = Path(__file__).resolve().parents[1]
NETWORKS = MODELS[1:]
"""Models with weights; the first of all is plane-sweep."""
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
CONFIGS = {"default": CompleterConfig(), "paper": CompleterConfig.paper()}
LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx")
"""Names of the profiler's events for a launch of a kernel."""
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize")
"""Names of the profiler's events for a wait of the host; a copy to the host waits by the first."""


@dataclass(frozen=True)
class Bench:
    """Settings of all parts; small ones on a CPU are for tests of this file."""

    device: str = "cuda"
    """Device, also the name of the renderer."""
    sizes: tuple[tuple[int, int], ...] = ((256, 256), (256, 448))
    """Heights and widths of the images."""
    models: tuple[str, ...] = MODELS
    dtypes: tuple[str, ...] = tuple(DTYPES)
    repetitions: int = 3
    """Timed runs, after a first one that is not timed; medians are reported."""

    @property
    def renderer(self) -> Renderer:
        return load_renderer(self.device)

    def make_camera(self, x: float, size: tuple[int, int], yaw: float = 0.0) -> Camera:
        """Make a camera of `size` in the room, with the focal length of a square one."""
        height, width = size
        camera = camera_at(x, yaw=yaw, size=height)
        K = camera.K.clone()
        K[0, 2] = width / 2
        return replace(camera, K=K, width=width)

    def make_views(self, size: tuple[int, int]) -> list[View]:
        shots = [view_of(Room(), self.make_camera(x, size), i) for i, x in enumerate((-0.3, 0.1))]
        return [shot.to(self.device) for shot in shots]

    def make_target(self, size: tuple[int, int]) -> Camera:
        return self.make_camera(0.5, size, yaw=10).to(self.device)

    def make_scene(self, views: list[View]) -> Gaussians:
        return merge([gaussians_of(view.to("cpu")) for view in views]).to(self.device)


def measure_build(bench: Bench) -> Iterator[Row]:
    """Measure the first import of gsplat's kernels, which compiles them, and the first render."""
    if bench.device == "cuda":
        yield Row(
            "gsplat's kernels are loaded", measure_median_seconds(load_kernels, 1, False), "s"
        )
    view = bench.make_views((64, 64))[0]
    scene = bench.make_scene([view])
    seconds = measure_median_seconds(
        lambda: bench.renderer.render(scene, view.camera), 1, warm=False
    )
    yield Row("first picture", seconds, "s")


def load_kernels() -> None:
    """Load gsplat's compiled kernels; it compiles them if nobody has before."""
    from gsplat.cuda._backend import _C

    if _C is None:
        raise RuntimeError("gsplat found no CUDA toolkit (nvcc) to compile its kernels with")


def run_tests(*arguments: str) -> Iterator[Row]:
    """Run pytest with these arguments; no passed test counts as a failure."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = done.stdout.strip().splitlines() or [shorten(done.stderr) or "no output"]
    for line in lines:
        if line.startswith(("FAILED", "ERROR")):
            yield Row("test", note=shorten(line), failed=True)
    whole = done.returncode == 0 and re.search(r"\d+ passed", lines[-1]) is not None
    yield Row(f"pytest {' '.join(arguments)}", note=lines[-1].strip("= "), failed=not whole)


def measure_agreement(bench: Bench) -> Iterator[Row]:
    """Compare renders and gradients with those of the reference renderer, in float64 on the CPU."""
    from render_scenes import (
        CAMERA,
        PARAMETERS,
        REFERENCE,
        SCENES,
        compute_gradients,
        find_covered_pixels,
        in_dtype,
    )

    camera = CAMERA.to(bench.device)
    for name, scene in SCENES.items():
        there = scene.to(bench.device)
        exact = in_dtype(scene, torch.float64)
        ours = bench.renderer.render(there, camera)
        truth = REFERENCE.render(exact, CAMERA)
        # Where next to nothing is drawn, the depth is a quotient of two roundings.
        covered = truth.alpha > 0.01
        for part in ("image", "alpha", "depth"):
            difference = (getattr(ours, part).cpu() - getattr(truth, part)).abs()
            if part == "depth":
                difference = difference[covered] / truth.depth[covered]
            shown = "largest relative difference" if part == "depth" else "largest difference"
            yield Row(f"{name}: {shown} of {part}", difference.max().item())
        compared = find_covered_pixels(name)
        gradients = compute_gradients(bench.renderer, there, compared.to(bench.device), camera)
        expected = compute_gradients(REFERENCE, exact, compared)
        for parameter in PARAMETERS:
            error = (gradients[parameter].cpu() - expected[parameter]).norm()
            relative = error / expected[parameter].norm().clamp_min(1e-12)
            yield Row(f"{name}: relative difference of gradients in {parameter}", relative.item())


def measure_renderer(bench: Bench) -> Iterator[Row]:
    """Measure a step of registration and of refinement, with and without a frozen scene."""
    for size in bench.sizes:
        views = bench.make_views(size)
        context, camera = bench.make_scene(views), bench.make_target(size)
        new = bench.make_scene([view_of(Room(), camera.to("cpu"))])
        shown = f"{size[0]}x{size[1]}, {len(context):,} frozen and {len(new):,} new"
        plain = RedrawnScene(bench.renderer, context, camera)
        frozen = bench.renderer.freeze(context, camera)
        for step, make in (("composite", make_composite_step), ("opacities", make_opacity_step)):
            anew = measure_median_seconds(make(plain, new), bench.repetitions)
            ours = measure_median_seconds(make(frozen, new), bench.repetitions)
            yield Row(f"{shown}: {step}, all anew", 1e3 * anew, "ms")
            yield Row(f"{shown}: {step}, frozen", 1e3 * ours, "ms", f"{anew / ours:.1f} times")


def make_composite_step(view: FrozenScene, new: Gaussians) -> Callable[[], None]:

    def step() -> None:
        means = new.means.clone().requires_grad_()
        view.composite(replace(new, means=means)).image.sum().backward()

    return step


def make_opacity_step(view: FrozenScene, new: Gaussians) -> Callable[[], None]:
    plan = view.vary_opacities(new)

    def step() -> None:
        opacities = new.opacities.clone().requires_grad_()
        plan(opacities).image.sum().backward()

    return step


def measure_stages(bench: Bench) -> Iterator[Row]:
    """Measure the stages of completions of the room with the embedded models.

    `paper` takes the 50 and 30 iterations of the paper, which states 0.69 s for registration and
    0.53 s for integration at 256x448 (Table VI).
    """
    for name, config in CONFIGS.items():
        complete = GSCompleter(
            PlaneSweep(device=bench.device),
            WarpInpaint(device=bench.device),
            renderer=bench.renderer,
            config=config,
        )
        for size in bench.sizes:
            views = bench.make_views(size)
            target = bench.make_target(size)
            complete(views, target)  # the first one compiles and loads kernels
            runs = [complete(views, target).seconds for _ in range(bench.repetitions)]
            for stage in runs[0]:
                seconds = statistics.median(run[stage] for run in runs)
                yield Row(f"{name}, {size[0]}x{size[1]}: {stage}", seconds, "s")


def measure_profile(bench: Bench) -> Iterator[Row]:
    """Count launches, waits of the host and seconds of kernels in each stage of a completion."""
    size = bench.sizes[-1]
    views = bench.make_views(size)
    target = bench.make_target(size)
    activities = [torch.profiler.ProfilerActivity.CPU]
    if bench.device == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    for name, config in CONFIGS.items():
        complete = GSCompleter(
            PlaneSweep(device=bench.device),
            WarpInpaint(device=bench.device),
            renderer=bench.renderer,
            config=config,
        )
        complete(views, target)
        with torch.profiler.profile(activities=activities) as profile:
            complete(views, target)
        events = profile.events()
        for stage in STAGES:
            spans = [
                event.time_range
                for event in events
                if event.name == STAGE_PREFIX + stage and event.device_type == DeviceType.CPU
            ]
            yield from summarize_stage(f"{name}: {stage}", events, spans)


def summarize_stage(what: str, events: Sequence[Any], spans: Sequence[Any]) -> Iterator[Row]:
    """Summarize the profiler's events that begin in `spans`, times in microseconds."""
    inside = [
        event
        for event in events
        if any(span.start <= event.time_range.start < span.end for span in spans)
        and not event.name.startswith(STAGE_PREFIX)
    ]
    kernels = [event for event in inside if event.device_type == DeviceType.CUDA]
    busy = sum(event.time_range.elapsed_us() for event in kernels)
    launches = sum(event.name in LAUNCHES for event in inside)
    waits = sum(event.name in WAITS for event in inside)
    wall = sum(span.elapsed_us() for span in spans)
    note = f"{launches:,} launches, {waits:,} waits, kernels take {1e-3 * busy:.1f} ms"
    yield Row(what, 1e-3 * wall, "ms", note)
    longest: Counter[str] = Counter()
    for event in kernels:
        longest[shorten_kernel(event.name)] += event.time_range.elapsed_us()
    for kernel, elapsed in longest.most_common(3):
        yield Row(f"{what}: kernel {kernel}", 1e-3 * elapsed, "ms")


def shorten_kernel(name: str) -> str:
    """Shorten the name of a kernel: without its return type, namespaces and arguments."""
    return re.sub(r"^void |\(.*|<.*", "", name).split("::")[-1][:60] or name[:60]


def measure_plane_sweep(bench: Bench) -> Iterator[Row]:
    """Measure plane-sweep with its kernels and on the device, and how far both agree.

    The last size is four times the usual one, about that of a photograph.
    """
    height, width = bench.sizes[-1]
    for size in (*bench.sizes, (4 * height, 4 * width)):
        views = bench.make_views(size)
        reconstructions = []
        for device in ("cpu", bench.device):
            shown = f"{size[0]}x{size[1]}, {'kernels' if device == 'cpu' else device}"
            reconstructor = PlaneSweep(device=device)
            for name, step in (
                ("depths", reconstructor.estimate_depths),
                ("context", reconstructor),
            ):
                seconds = measure_median_seconds(partial(step, views), bench.repetitions)
                yield Row(f"{shown}: {name}", seconds, "s")
            reconstructions.append(reconstructor(views))
        yield from compare_reconstructions(bench, f"{size[0]}x{size[1]}", views, *reconstructions)


def compare_reconstructions(
    bench: Bench, shown: str, views: list[View], expected: Reconstruction, found: Reconstruction
) -> Iterator[Row]:
    """Compare the depths of two reconstructions, and how well both reproduce the photographs."""
    differences = [
        ((ours.depth - truth.depth).abs() / truth.depth)[truth.valid]
        for ours, truth in zip(found.depths, expected.depths, strict=True)
    ]
    difference = torch.cat(differences)
    share = (difference > 1e-4).float().mean().item()
    note = f"largest {difference.max().item():.2g}"
    yield Row(f"{shown}: measured pixels whose depth differs by more than 1e-4", share, "", note)
    for number, view in enumerate(views):
        before, after = (
            psnr(bench.renderer.render(part.gaussians, view.camera).image, view.image)
            for part in (expected, found)
        )
        what = f"{shown}: photograph {number}, better on the device by"
        yield Row(what, after - before, "dB", f"kernels: {before:.2f} dB")


@dataclass(frozen=True)
class KeptLevels:
    """Fills with the kernels, and keeps what there was to do."""

    levels: list[PatchRounds]

    def choose_rounds(self, num_patches: int) -> RunRounds:
        """Choose a function that keeps the rounds."""

        def run(rounds: PatchRounds) -> tuple[Any, Any]:
            self.levels.append(rounds)
            return run_with_kernels(rounds)

        return run


def measure_patches(bench: Bench) -> Iterator[Row]:
    """Measure the search for patches with its kernels and on the device, and how far both agree.

    Each level alone, whatever its number of patches: `MIN_DEVICE_PATCHES` should be that from which
    the device is faster. Then images, with the levels where they belong. The last size is four
    times the usual one, about that of a photograph.
    """
    height, width = bench.sizes[-1]
    for size in (*bench.sizes, (4 * height, 4 * width)):
        shown = f"{size[0]}x{size[1]}"
        views, target = bench.make_views(size), bench.make_target(size)
        scene = bench.make_scene(views)
        seen = tuple(bench.renderer.render(scene, view.camera) for view in views)
        context = GeneratorInput(tuple(views), seen, bench.renderer.render(scene, target))
        levels: list[PatchRounds] = []
        with patch.dict(PATCH_DEVICES, {"cpu": lambda _, kept=levels: KeptLevels(kept)}):
            WarpInpaint()(views[1], target, context)
        for rounds in levels:
            yield from compare_rounds(bench, f"{shown}, {len(rounds.matches):,} patches", rounds)
        images = []
        for device in ("cpu", bench.device):
            fill = partial(WarpInpaint(device=device), views[1], target, context)
            seconds = measure_median_seconds(fill, bench.repetitions)
            kind = "kernels" if device == "cpu" else device
            yield Row(f"{shown}: image, {kind}", seconds, "s")
            images.append(fill())
        difference = (images[1] - images[0]).abs().amax(dim=-1)
        share = (difference > 1e-3).float().mean().item()
        note = f"largest {difference.max().item():.2g}"
        yield Row(f"{shown}: pixels that differ by more than 1e-3", share, "", note)


def compare_rounds(bench: Bench, shown: str, rounds: PatchRounds) -> Iterator[Row]:
    """Fill a level with the kernels and on the device."""
    filled = []
    for name, run in (
        ("kernels", run_with_kernels),
        (bench.device, partial(run_with_tensors, device=bench.device)),
    ):
        seconds = measure_median_seconds(partial(run, rounds), bench.repetitions)
        yield Row(f"{shown}: {rounds.num_rounds} rounds, {name}", 1e3 * seconds, "ms")
        filled.append(run(rounds))
    (expected, field), (image, matches) = filled
    moved = (field != matches).any(axis=1).mean().item()
    note = f"largest difference of colours {abs(image - expected).max():.2g}"
    yield Row(f"{shown}: matches that differ", moved, "", note)


def measure_completions(bench: Bench) -> Iterator[Row]:
    """Complete with all models; with random weights only success and provenance are checked."""
    size = bench.sizes[0]
    views, target = bench.make_views(size), bench.make_target(size)

    def completed(name: str) -> Iterator[Row]:
        network, _ = load_model(name, bench.device)
        done = GSCompleter(reconstructor=network, renderer=bench.renderer)(views, target)
        added = int((done.scene.generated > 0).sum())
        finite = bool(done.scene.means.isfinite().all())
        if added != len(done.added) or not finite:
            raise RuntimeError(f"{added} marked of {len(done.added)} added, finite: {finite}")
        yield Row(name, done.seconds["total"], "s", f"{added:,} Gaussians added")

    for name in bench.models:
        yield from try_rows(name, lambda name=name: completed(name))


def measure_commands(bench: Bench) -> Iterator[Row]:
    """Run the command line on photographs of the room, each command in a process of its own.

    The seconds are those of whole processes, with the start of Python and of CUDA.
    """
    size = bench.sizes[0]
    cameras = [bench.make_camera(x, size, yaw) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    with TemporaryDirectory() as folder:
        room = photographed(Path(folder) / "room", cameras)
        out = Path(folder) / "out"
        given = Path(folder) / "of-a-splat"
        commands = {
            "complete": f"complete {room} --context 0 1 --target 2 --out {out}",
            "complete --config paper": (
                f"complete {room} --context 0 1 --target 2 --out {out}-paper --config paper"
            ),
            "complete --scene": (
                f"complete {room} --scene {out}/context.ply --target 2 --out {given}"
            ),
            "remove": (
                f"remove {room} --scene {out}/context.ply --sphere -0.1 0.9 2.6 0.6 "
                f"--out {out}-removed"
            ),
            "clean": f"clean {room} --scene {out}/completed.ply --out {out}-cleaned",
        }
        for name, words in commands.items():
            yield from try_rows(name, lambda n=name, w=words: run_command(bench, n, w))


def run_command(bench: Bench, name: str, words: str) -> Iterator[Row]:
    """Run a command of the package on the device of the bench."""
    run = "from gscompleter.cli import run; run()"
    command = [sys.executable, "-c", run, *words.split(), "--device", bench.device]
    start = read_clock()
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    seconds = read_clock() - start
    said = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
    yield Row(
        name, seconds, "s", "" if done.returncode == 0 else shorten(said), done.returncode != 0
    )


def measure_models(bench: Bench) -> Iterator[Row]:
    """Measure two photographs through each network."""
    views = bench.make_views(bench.sizes[0])

    def passed(name: str, dtype: str) -> Iterator[Row]:
        network, _ = load_model(name, bench.device, DTYPES[dtype])
        found = measure_repeatedly(network, views, bench.repetitions)
        peak = "" if found.peak_bytes is None else f"{found.peak_bytes / 2**30:.2f} GiB"
        yield Row(f"{name}, {dtype}", 1e3 * found.seconds, "ms", peak)

    for name in bench.models:
        if name in NETWORKS:
            for dtype in bench.dtypes:
                what = f"{name}, {dtype}"
                yield from try_rows(what, lambda n=name, d=dtype: passed(n, d))


def measure_baselines(bench: Bench) -> Iterator[Row]:
    """Measure the methods of others that need the renderer: densification and RegGS."""
    size = bench.sizes[0]
    views = bench.make_views(size)
    scene = bench.make_scene(views)
    target = bench.make_target(size)
    reference = view_of(Room(), target.to("cpu")).to(bench.device)
    lifted = bench.make_scene([reference])
    iterations = 4 * bench.repetitions

    def densified() -> Iterator[Row]:
        config = OptimizationConfig(iterations=iterations)
        seconds = measure_median_seconds(
            lambda: optimize(scene, [*views, reference], bench.renderer, 0, config), 1
        )
        yield Row(f"densification, {iterations} iterations", seconds, "s")

    def registered() -> Iterator[Row]:
        config = RegGSConfig(iterations=iterations)
        seconds = measure_median_seconds(
            lambda: register_by_similarity(lifted, scene, reference, bench.renderer, 0, config), 1
        )
        yield Row(f"RegGS, {iterations} iterations", seconds, "s")

    yield from try_rows("densification", densified)
    yield from try_rows("RegGS", registered)


def measure_pe_field(bench: Bench, kontext: Callable[[str], Any] | None = None) -> Iterator[Row]:
    """Measure an image in four steps, with encoding and decoding."""
    size = bench.sizes[-1]
    views, target = bench.make_views(size), bench.make_target(size)
    scene = bench.make_scene(views)
    seen = tuple(bench.renderer.render(scene, view.camera) for view in views)
    context = GeneratorInput(tuple(views), seen, bench.renderer.render(scene, target))
    generator = PEField((kontext or build_random_kontext)(bench.device))

    def painted() -> None:
        generator.generate_images(
            [generator.create_condition(GeneratorRequest(views[1], target, context))], seed=0
        )

    seconds = measure_median_seconds(painted, bench.repetitions)
    yield Row(f"{size[0]}x{size[1]}, {generator.steps} steps", seconds, "s")
    if bench.device == "cuda":
        peak = torch.cuda.max_memory_allocated() / 2**30
        yield Row("most memory that torch held", peak, "GiB")


def build_random_kontext(device: str) -> Any:
    """Build FLUX Kontext with random weights and an empty prompt."""
    from diffusers import AutoencoderKL, FlowMatchEulerDiscreteScheduler, FluxKontextPipeline

    from bench_pe_field import BLOCKS, TEXT
    from gscompleter.models.diffusion.kontext import Kontext, Prompt
    from gscompleter.models.diffusion.rotary import enable_per_head_positions

    dtype, levels = select_dtype(device), 4
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
        transformer=enable_per_head_positions(build_transformer(BLOCKS, device)),
        **unused,
    )
    tokens = torch.zeros(1, TEXT, 4096, device=device, dtype=dtype)
    pooled = torch.zeros(1, 768, device=device, dtype=dtype)
    return Kontext(pipeline, Prompt(tokens, pooled), device, dtype)


def measure_free_models(bench: Bench, klein: Callable[[str], Any] | None = None) -> Iterator[Row]:
    """Measure the models that anyone may use: FLUX.2 [klein], and published files that are here."""
    size = bench.sizes[0]
    views, target = bench.make_views(size), bench.make_target(size)
    scene = bench.make_scene(views)
    seen = tuple(bench.renderer.render(scene, view.camera) for view in views)
    context = GeneratorInput(tuple(views), seen, bench.renderer.render(scene, target))
    requests = [GeneratorRequest(views[1], target, context)]

    def painted() -> Iterator[Row]:
        pipeline = (klein or build_random_klein)(bench.device)
        generator = DiffusersInpaint(Editor(pipeline, *get_size_rules(pipeline)), steps=4)
        seconds = measure_median_seconds(lambda: generator.synthesize(requests), bench.repetitions)
        yield Row("flux2-klein, 4 steps", seconds, "s")

    def ran(name: str) -> Iterator[Row]:
        if find_cached(PUBLISHED[name]) is None:
            yield Row(name, note="its file is not on this machine")
        elif name in DEPTH_PREDICTORS:
            predict = load_depth_predictor(name, device=bench.device)
            yield Row(
                name, measure_median_seconds(lambda: predict(views[0]), bench.repetitions), "s"
            )
        else:
            phi = load_generator(name, device=bench.device)
            yield Row(
                name,
                measure_median_seconds(lambda: phi.synthesize(requests), bench.repetitions),
                "s",
            )

    yield from try_rows("flux2-klein", painted)
    for name in ("migan", "lama", *(depth for depth in DEPTH_PREDICTORS if depth in PUBLISHED)):
        yield from try_rows(name, lambda name=name: ran(name))


def build_random_klein(device: str) -> Any:
    """Build FLUX.2 [klein] 4B with random weights and a tokenizer of letters."""
    import diffusers
    from transformers import Qwen3Config, Qwen3ForCausalLM

    language = Qwen3Config(
        vocab_size=151_936,
        hidden_size=2560,
        intermediate_size=9728,
        num_hidden_layers=36,
        num_attention_heads=32,
        num_key_value_heads=8,
        head_dim=128,
    )
    before, default = torch.get_default_dtype(), select_dtype(device)
    torch.set_default_dtype(default)
    try:
        with torch.device(device):
            transformer = diffusers.Flux2Transformer2DModel(
                num_layers=5,
                num_single_layers=20,
                num_attention_heads=24,
                joint_attention_dim=7680,
                guidance_embeds=False,
            )
            vae, encoder = diffusers.AutoencoderKLFlux2(), Qwen3ForCausalLM(language)
    finally:
        torch.set_default_dtype(before)
    return diffusers.Flux2KleinPipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=vae.eval(),
        text_encoder=encoder.eval(),
        tokenizer=tiny_diffusion.qwen3(1)["tokenizer"],
        transformer=transformer.eval(),
        is_distilled=True,
    )


def parse_size(text: str) -> tuple[int, int]:
    """Parse a height and a width, such as 256x448."""
    height, width = map(int, text.split("x"))
    return height, width


SIZES = os.environ.get("GPU_SIZES")
BENCH = Bench() if SIZES is None else Bench(sizes=tuple(map(parse_size, SIZES.split())))
GPU_TESTS = "tests/render/test_render.py"
"""File with all tests marked `gpu`: collecting the others takes half a minute."""
PARTS = {
    "build": Part("gsplat compiles", 200, lambda: measure_build(BENCH)),
    "agreement": Part(
        "Agreement with the reference renderer", 60, lambda: measure_agreement(BENCH), needs="build"
    ),
    "renderer": Part(
        "Renderer, a step of optimisation", 60, lambda: measure_renderer(BENCH), needs="build"
    ),
    "stages": Part(
        "Stages, embedded models (medians)", 120, lambda: measure_stages(BENCH), needs="build"
    ),
    "profile": Part("Profile of a completion", 90, lambda: measure_profile(BENCH), needs="build"),
    "plane-sweep": Part(
        "Plane-sweep, kernels and device", 120, lambda: measure_plane_sweep(BENCH), needs="build"
    ),
    "patches": Part(
        "Patches of Φ, kernels and device", 60, lambda: measure_patches(BENCH), needs="build"
    ),
    "tests": Part("Tests", 90, lambda: run_tests(GPU_TESTS, "-m", "gpu"), needs="build"),
    "completions": Part(
        "A completion with every Ψ", 120, lambda: measure_completions(BENCH), needs="build"
    ),
    "commands": Part("The command line", 120, lambda: measure_commands(BENCH), needs="build"),
    "models": Part("Ψ, two photographs at 256x256", 90, lambda: measure_models(BENCH)),
    "pe-field": Part("PE-Field, all of it", 120, lambda: measure_pe_field(BENCH), needs="build"),
    "baselines": Part("Methods of others", 60, lambda: measure_baselines(BENCH), needs="build"),
    "free-models": Part(
        "Models for any use", 120, lambda: measure_free_models(BENCH), needs="build"
    ),
}
"""The most valuable ones first: those at the end are left out where the time is over."""


def describe_machine() -> dict[str, str]:
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
        "gsplat": get_installed_version("gsplat"),
        "diffusers": get_installed_version("diffusers"),
        "python": platform.python_version(),
        "date": date.today().isoformat(),
    }


def get_installed_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    main(PARTS, describe_machine, __doc__ or "")
