"""What the commands can be told. The command line is derived from these classes.

Nothing here imports torch, so that `gscompleter --help` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gscompleter.batch.engines import EngineName
from gscompleter.commands.generator_options import GeneratorOptions
from gscompleter.config import CompleterConfig
from gscompleter.config.cleaning import CleaningConfig
from gscompleter.config.settings import Seed, Settings

Frame = Annotated[int, Interval(ge=0, lt=10**9)]
Port = Annotated[int, Interval(ge=0, le=65535)]
Device = Literal["auto", "cpu", "cuda"]
Size = tuple[int, int] | int | Literal["full"]
"""Height and width, the most pixels of the longer side, or the photographs' own size."""
LONG_SIDE = 640
"""Most pixels of the longer side of a photograph, where nobody says."""

FOUND = 4
"""Cameras that are found at most, where nobody says how many."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """What every command can be told that does something."""

    quiet: bool = False
    """Say nothing but errors."""


@dataclass(frozen=True, kw_only=True)
class ComputeOptions(Options):
    """What every command can be told that computes for long."""

    threads: Annotated[int, Interval(ge=1, le=1024)] | None = None
    """How many threads compute; as many as there are usable cores if not given. A completion on a
    CPU does not depend on it."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(ComputeOptions):
    """What every command can be told that completes something."""

    device: Device = "auto"
    """Where to run."""
    seed: Seed = 0
    """Of everything random. The same seed gives the same bytes on a CPU."""

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models that are asked for, whatever the photographs are."""
        return ()


@dataclass(frozen=True, kw_only=True)
class ModelOptions(RunOptions):
    """What every command can be told that lets its models be chosen."""

    reconstructor: str = "plane-sweep"
    """The model that turns views into Gaussians: plane-sweep, which needs no weights, or one of
    those that `gscompleter models` lists."""
    weights: Path | None = None
    """The file of its weights, where they are not to be downloaded."""
    synthesis: Annotated[GeneratorOptions, tyro.conf.OmitArgPrefixes] = GeneratorOptions()
    """How the image at a target comes about."""

    @property
    def models(self) -> tuple[str, ...]:
        return self.reconstructor, self.synthesis.name


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ComputeOptions):
    """What every command can be told that opens posed photographs, and may bring a splat."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Posed photographs: a folder with a COLMAP model or a nerfstudio transforms.json, a
    cameras.json beside its photographs, a poses_bounds.npy of LLFF, a sequence of KITTI, a scene
    of DGP, a segment of Waymo, a sequence of PandaSet, a chunk of pixelSplat, or a camera file of
    RealEstate10K beside its frames. The cameras of photographs that have none are found by COLMAP
    and kept in OUT/colmap."""
    context: tuple[Frame, ...] | None = None
    """Numbers of the frames to work with, in the order of the sorted file paths."""
    out: Path
    """The folder to write."""
    format: str | None = None
    """What SCENE is: colmap, nerfstudio, cameras-json, llff, kitti, kitti-raw, dgp, waymo,
    mmdet3d, pandaset, chunks or real-estate-10k. Found by what lies there if not given."""
    scene: Path | None
    """A file of Gaussians."""
    resolution: Size = LONG_SIDE
    """Height and width to work at: photographs are scaled to cover it and cropped around the
    centre. One number is the most pixels of the longer side, to which larger photographs are
    shrunk; `full` keeps their own size."""
    near: float | None = None
    """Smallest depth in the scene, in its own unit. Estimated if not given."""
    far: float | None = None
    """Largest depth in the scene, in its own unit. Estimated if not given."""
    drop_nonfinite: bool = False
    """Leave out Gaussians of the scene that hold NaN or infinity."""
    overwrite: bool = False
    """Replace what an earlier run left in the output folder."""


@dataclass(frozen=True, kw_only=True)
class CompletingOptions(SceneOptions, ModelOptions):
    """What every command can be told that opens a scene and completes it."""

    scene: Path | None = None
    """A file of Gaussians to complete, which is kept as it is. Without it the context is
    reconstructed from the photographs."""
    no_prune: bool = False
    """Never set Gaussians of the scene aside that no photograph supports."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = CompleterConfig()
    """Settings of the stages. `--config NAME` says where they start: default, paper, an ablation
    such as no-sa, or a YAML file. Those given here are applied over it."""


@dataclass(frozen=True, kw_only=True)
class CompleteOptions(CompletingOptions):
    """Fill what the photographs never saw, as seen from the targets, and write the scene."""

    context: tuple[Frame, ...] | None = None
    """Numbers of the frames to start from, in the order of the sorted file paths. If not given,
    those that matter to the targets are chosen, or without a target those that show most; a
    target's own photograph is none of them."""
    target: tuple[str, ...] = ()
    """Frames to complete the scene for, by number, or a file of cameras (transforms.json,
    cameras.json, COLMAP's images.txt, SuperSplat's poses). Several are
    completed one after the other into one scene. If not given, cameras are found that see holes,
    and targets.json has them."""
    auto: Annotated[int, Interval(ge=1, le=255)] | None = None
    """How many cameras are found at most, where no target is given: 4 unless a number is named.
    Fewer are taken where little is left to complete."""
    dry_run: bool = False
    """Only write targets.json, which can be edited and given to --target, and show what would be
    done."""
    out: Path
    """Folder for completed.ply, generated.ply, context.ply, targets.json, images/, report.html,
    report.json and summary.json."""
    video: bool = False
    """Write video.mp4, too: about six seconds on the way through the holes, before and after side
    by side."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(CompletingOptions):
    """Complete a scene in the browser: fly to a hole, press a button, and watch it close.

    Every step can be undone. What is saved is what `gscompleter complete` writes for the same
    photographs and the cameras in OUT/targets.json.
    """

    context: tuple[Frame, ...] | None = None
    """Numbers of the frames to start from, in the order of the sorted file paths; those that show
    most if not given."""
    out: Path = Path("live")
    """Folder that the button Save writes, with the files that `complete` writes."""
    resolution: Size = (256, 256)
    """Height and width to work at, as `complete` has it. Smaller is faster."""
    port: Port = 0
    """Port to serve at; any that is free if not given."""
    host: str = "127.0.0.1"
    """Address to serve at. Whoever reaches it can press the buttons; the default is this machine
    alone."""
    no_open: bool = False
    """Only say where the page is, and open no browser."""


@dataclass(frozen=True, kw_only=True)
class CleanOptions(SceneOptions):
    """Take out of a splat what its photographs are better without or do not need.

    Nothing is generated, and no photograph is matched worse by more than a hundredth of a decibel.
    `gscompleter strip` puts back what was taken out.
    """

    context: tuple[Frame, ...] | None = None
    """Numbers of the frames that judge, in the order of the sorted file paths. All that have a
    photograph if not given. What only others need is not safe."""
    out: Path
    """Folder for completed.ply, removed.ply and summary.json."""
    scene: Path
    """The file of Gaussians to clean."""
    device: Device = "auto"
    """Where to run."""
    config: CleaningConfig = CleaningConfig()
    """What is taken out."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions(RunOptions):
    """Complete a real stereo pair beyond its left and its right camera, and show before/after.

    The photographs are the Middlebury motorcycle pair that scikit-image carries. Nothing is
    downloaded.
    """

    out: Path = Path("demo")
    """Folder for the scene, its completion and before_after.png."""
    overwrite: bool = False
    """Replace what an earlier run left in the output folder."""

    @property
    def models(self) -> tuple[str, ...]:
        return ModelOptions().models


@dataclass(frozen=True, kw_only=True)
class EngineOptions(Options):
    """What every command can be told that lets others do its work."""

    engine: EngineName | None
    """Who does the work."""
    workers: Annotated[int, Interval(ge=1, le=100_000)] | None = None
    """How many workers there are. If not given, as many as there are cores and memory for on this
    machine, as the cluster of Ray has room for, or one job of SLURM."""
    threads: Annotated[int, Interval(ge=1, le=1024)] | None = None
    """How many threads compute in each; if not given, the cores are shared out on this machine,
    and it is one elsewhere."""
    address: str | None = None
    """Of a cluster of Ray that is there; one is started on this machine if not given."""
    gpus: Annotated[float, Interval(ge=0, le=1024)] = 0.0
    """GPUs that a worker of Ray or SLURM holds; of Ray also a part of one."""
    slurm: tuple[str, ...] = ()
    """What SLURM is told with --engine submitit, as in --slurm partition=gpu time=120."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(ModelOptions, EngineOptions):
    """Run methods on cases of which the truth is known, and score them.

    Run again with the same options, it goes on where it was stopped. The tables are printed and
    written at the end; `gscompleter tables OUT` writes them at any time.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A cases.json; or, with --protocol, scenes: folders with a transforms.json or of such
    folders, chunks of pixelSplat, camera files of RealEstate10K, or drives (Waymo, nuScenes, KITTI,
    DDAD, PandaSet), of which the front camera is taken."""
    out: Path
    """Folder for the results, a new one or that of an earlier run to go on with."""
    protocol: tuple[str, ...] = ()
    """Choice of the given frames and the target: n-10 (frames n and n + 10 for n + 20, then
    n + 20 and n + 10 for n, for n = 0, 21, 42, …, which is how we read the n-k of the paper; see
    --one-per-scene), stress (0 and 30 for 99), or the path of an evaluation index; one or several.
    A cases.json needs none. sequence-4 (or sequence-4-steps-6) completes each clip view after view:
    frames 0 and 4 are given, then 8, 12, … are completed one after the other into one scene, and
    once it is completed the photograph of a frame is given too. It takes context, full, paper,
    ablations and reggs; the paper's study of long sequences is that with --generator oracle."""
    methods: tuple[str, ...] = ("context", "full", "paper")
    """What to compare: context, full, paper, an ablation such as no-sa, densify-100, densify-800,
    distill, reggs; or a group of them: ablations, baselines, all."""
    rerun: Literal["nothing", "failures", "scores"] = "nothing"
    """What of an earlier run is done once more: cases that failed, or all scores, from the
    predictions that were saved."""
    shard: str | None = None
    """i/n does every n-th case from the i-th on, i from 0 to n - 1; auto takes both from an array
    of SLURM. Processes without it share the work, too."""
    engine: EngineName | None = None
    """Who does the work; this process alone if not given."""
    resolution: Size | None = None
    """What to work at, as `complete` has it. If not given, the resolution of the cases, or for
    scenes that of `complete`."""
    use_masks: bool = False
    """Ignore what masks cover in the photographs, and boxes around what moves: nothing is made of
    it, and it does not count in the scores."""
    one_per_scene: bool = False
    """Take one case of each scene: the first of each protocol (of n-10 frames 0 and 10 for 20) or
    of a cases.json. The paper counts as many cases as scenes."""
    ego_mask: bool = True
    """Ignore parts of photographs that stay the same while the camera moves, such as the bonnet of
    the vehicle that carries it, in all methods and in the scores."""
    limit: Annotated[int, Interval(ge=1)] | None = None
    """Most cases to do, in all shards together."""


@dataclass(frozen=True, kw_only=True)
class TablesOptions(Options):
    """Write the tables of what `evaluate` has done so far, and print them."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder that `evaluate` wrote. The tables and plots go there."""
    fid: bool = False
    """Compare the pictures of each method with the photographs by FID, too."""


@dataclass(frozen=True, kw_only=True)
class IndexOptions(Options):
    """Write down which frames a protocol chooses in a data set."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Scenes, as `evaluate` takes them."""
    protocol: str
    """As `evaluate` takes it."""
    out: Path
    """The evaluation index, a JSON file."""
    overwrite: bool = False
    """Replace the file where there is one."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions(RunOptions):
    """Measure what completions take on this machine, and how that grows.

    Every completion is a process of its own, start-up included; methods are compared within one
    process. All times are also told in yardsticks: the renderer, forward and backward, on 196,608
    Gaussians at 256 x 256, just before and just after. Without a scene or cases it is the stereo
    pair of `gscompleter demo` that is completed. The tables are printed.
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """Posed photographs, as `complete` takes them; --context and --target name frames."""
    context: tuple[Frame, ...] = ()
    """Frames to start from."""
    target: tuple[Frame, ...] = ()
    """Frames to complete the scene for. Methods are compared on the first."""
    resolution: tuple[int, int] = (256, 256)
    """Height and width to work at, without --cases."""
    near: float | None = None
    """Smallest depth in the scene, in its own unit. Estimated if not given."""
    far: float | None = None
    """Largest depth in the scene, in its own unit. Estimated if not given."""
    cases: Path | None = None
    """A JSON file that names cases, and what they grow over, instead of a scene; as
    benchmarks/performance.json does. Methods are compared on the first."""
    only: tuple[str, ...] = ()
    """Names of cases; all of the file if none is given."""
    methods: tuple[str, ...] = ("full", "autograd", "densify-800", "distill", "reggs")
    """What to compare: full, which is ours, autograd, which is ours without a frozen context,
    densify-100, densify-800, distill, reggs."""
    growth: tuple[Literal["gaussians", "pixels", "views", "targets"], ...] = (
        "gaussians",
        "pixels",
        "views",
        "targets",
    )
    """Over what to let the first case grow."""
    repeats: Annotated[int, Interval(ge=1, le=1000)] = 5
    """How often everything is measured."""
    baseline_repeats: Annotated[int, Interval(ge=1, le=1000)] = 1
    """How often at most methods are that take minutes: all but full and autograd."""
    quick: bool = False
    """Only try it: the smallest case, once, kernels compiled or not, two iterations of the
    baselines, no growth."""
    json: bool = False
    """Print everything that was measured as JSON, instead of the tables."""
    out: Path | None = None
    """Folder for bench.json, tables.md and growth.png."""
    overwrite: bool = False
    """Replace what an earlier run left in the output folder."""


@dataclass(frozen=True, kw_only=True)
class ModelsOptions(Settings):
    """List the published weights: what they are, under which licence, and which are cached."""

    json: bool = False
    """Print everything that is known of them as JSON."""


def most(options: CompleteOptions) -> int:
    """How many targets are found, where none is named."""
    return FOUND if options.auto is None else options.auto


def working_size(given: Size) -> tuple[int, int] | int | None:
    """What `--resolution` asks for, as posed photographs take it."""
    return None if given == "full" else given
