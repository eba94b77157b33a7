"""Options of the commands, from which the command line is derived. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gscompleter.config import CleaningConfig, CompleterConfig
from gscompleter.config.generators import GeneratorOptions
from gscompleter.config.settings import Seed, Settings
from gscompleter.system.jobs.engines import EngineName

Frame = Annotated[int, Interval(ge=0, lt=10**9)]
Words = Annotated[tuple[int | str, ...] | None, tyro.conf.arg(metavar="PHOTO [PHOTO ...]")]
Threads = Annotated[int, Interval(ge=1, le=1024)]
Port = Annotated[int, Interval(ge=0, le=65535)]
Axis = Literal["gaussians", "pixels", "views", "targets"]
# fmt: off
TableName = Literal[
    "models", "ablation", "refinement", "time", "dof", "alignment", "spans", "stress", "steps",
    "rotation", "paradigms", "sequence", "all",
]
FigureName = Literal[
    "qualitative", "densification", "registration", "seams", "sequence", "all"
]
# fmt: on
NumFrames = Annotated[int, Interval(ge=3, le=1000)]
AUTO = "auto"
"""Generator of the preset, or else the default one."""
Device = Literal["auto", "cpu", "cuda"]
Size = tuple[int, int] | int | Literal["full"]
"""Height and width, the longest side, or `full` for the photographs' own size."""
LONG_SIDE = 640
"""Default length of a photograph's longer side, in pixels."""

DEFAULT_NUM_TARGETS = 4
OUTPUTS = ("out", "save")
"""Options that name what a command writes."""
WORDS_OR_PATHS = ("target", "protocol", "generator_weights")
"""Options whose words may be paths of files that are read."""
REMOVAL_CONFIG = CompleterConfig.splat().for_removal()


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Options of every command that writes something."""

    quiet: bool = False
    """Print errors only."""


@dataclass(frozen=True, kw_only=True)
class WritingOptions(Options):
    """Options of every command that replaces earlier results on request only."""

    overwrite: bool = False
    """Replace an existing file, or in the output folder the files that an earlier run wrote."""


@dataclass(frozen=True, kw_only=True)
class ComputeOptions(Options):
    """Options of every command that computes for long."""

    threads: Threads | None = None
    """CPU threads to compute with; all available cores if not given."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(ComputeOptions):
    """Options of every command that completes scenes."""

    device: Device = "auto"
    """Device to compute on; `auto` takes an NVIDIA GPU if there is one."""
    seed: Seed = 0
    """Seed of all random numbers. The same seed gives the same files on CPUs of one type."""


@dataclass(frozen=True, kw_only=True)
class SynthesisOptions(RunOptions):
    """Options of every command with a choice of the generator."""

    depth: str = "none"
    """Monocular depth that helps plane-sweep where stereo measures nothing: none, or moge-2."""
    depth_weights: Path | None = None
    """Weights file of that depth; downloaded if not given."""
    synthesis: Annotated[GeneratorOptions, tyro.conf.OmitArgPrefixes] = GeneratorOptions()


@dataclass(frozen=True, kw_only=True)
class ModelOptions(SynthesisOptions):
    """Options of every command with a choice of models."""

    reconstructor: str = "plane-sweep"
    """Model that turns photographs into Gaussians: plane-sweep, or one of `gscompleter models`."""
    weights: Path | None = None
    """Weights file of the reconstructor; downloaded if not given."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ComputeOptions, WritingOptions):
    """Options of every command that opens photographs with cameras."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder of the photographs: COLMAP, nerfstudio, cameras.json, LLFF, KITTI, DGP, Waymo,
    PandaSet, a pixelSplat chunk, a RealEstate10K camera file, or what Polycam, Record3D or 3d
    Scanner App exports. If it has no cameras, COLMAP finds them and they are kept in OUT/colmap;
    also of 360° panoramas (2:1) and of a video (.mp4, .mov, .mkv). One image needs none."""
    frames: NumFrames = 40
    """Most frames of a video to take as photographs, sharp ones at even steps of the camera."""
    context: Words = None
    """Photographs to work with: file names, or numbers from 0 in the order of the file paths. If
    not given, those that help most; photographs of targets are never used. `clean` takes all."""
    out: Path
    format: str | None = None
    """Format of SCENE: colmap, nerfstudio, cameras-json, llff, kitti, kitti-raw, dgp, waymo,
    mmdet3d, pandaset, chunks, real-estate-10k, polycam, record3d, 3d-scanner-app or photograph.
    Detected if not given."""
    scene: Path | None
    resolution: Size | None = None
    """Working size: the longest side in pixels (photographs are never enlarged), or height and
    width (photographs are scaled and cropped), or `full`. If not given, 640, or the size that the
    splat was trained at if that is smaller."""
    near: float | None = None
    """Smallest depth in the scene, in the unit of its cameras; if not given, that of the data or of
    the model's authors, or else estimated."""
    far: float | None = None
    """Largest depth in the scene, in the unit of its cameras; if not given, as for near."""
    no_given_depth: bool = False
    """Ignore the depth that SCENE holds: depth maps, laser sweeps and COLMAP's points."""
    masks: bool = True
    """Ignore what masks (black) or alpha channels of SCENE hide."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""


@dataclass(frozen=True, kw_only=True)
class CompletingOptions(SceneOptions, ModelOptions):
    """Options of the commands that complete one scene."""

    scene: Path | None = None
    """File of Gaussians (a splat) to complete instead of reconstructing the scene; all are kept."""
    no_recolor: bool = False
    """Keep the colours of the splat, too; Gaussians are only added where it is empty."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = CompleterConfig()
    """Settings of the method, which change those of `--config NAME`."""


@dataclass(frozen=True, kw_only=True)
class CompleteOptions(CompletingOptions):
    """Fill the parts of a scene that its photographs do not show, and write the result."""

    target: tuple[str, ...] = ()
    """Cameras to complete the scene for: file names or numbers of photographs, or a file of cameras
    (transforms.json, cameras.json, nerfstudio's camera_path.json, COLMAP's images.txt, SuperSplat
    poses). If not given, cameras that see holes are searched for and written to targets.json."""
    auto: Annotated[int, Interval(ge=1, le=254)] | None = None
    """Most cameras to search for if no target is given; 4 if no number follows."""
    dry_run: bool = False
    """Only print the plan, and write its cameras to targets.json, which `--target` reads."""
    out: Path
    """Folder for completed.ply, the report (report.html), images and summary.json."""
    video: bool = False
    """Also write video.mp4: a flight through the holes, before and after side by side."""


@dataclass(frozen=True, kw_only=True)
class RemoveOptions(CompleteOptions):
    """Remove something from a splat, and complete the hole that it leaves.

    What other photographs show behind it fills the hole, and the generator invents the rest.
    `gscompleter strip` gives the splat back as it was. Coordinates are those of the splat's file.
    """

    scene: Path = field()  # without the default of `complete`
    """File of Gaussians (a splat) to remove something from."""
    box: tuple[float, ...] = ()
    """Remove Gaussians inside of boxes: smallest x, y and z of each, then largest."""
    box_rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the boxes about their centres, as a quaternion w x y z."""
    sphere: tuple[float, float, float, float] | None = None
    """Remove Gaussians inside of a sphere: x, y and z of its centre, and its radius."""
    mask: Path | None = None
    """Remove what masks show: a folder of images named as photographs, white there."""
    select: Path | None = None
    """Remove the Gaussians of this file, a selection that another program saved."""
    config: Annotated[CompleterConfig, tyro.conf.FlagConversionOff] = REMOVAL_CONFIG
    """Settings of the method, which change those of `--config NAME`."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(CompletingOptions):
    """Complete a scene in the browser: fly to a hole, press a button, and watch it close."""

    out: Path = Path("live")
    """Output folder of the Save button."""
    resolution: Size = (256, 256)
    """Working size as in `complete`; smaller is faster."""
    port: Port = 0
    """Port of the page; a free one if not given."""
    host: str = "127.0.0.1"
    """Address of the page, such as 127.0.0.1 or ::1. Anyone who can reach it can use it."""
    no_open: bool = False
    """Print the address without opening a browser."""


@dataclass(frozen=True, kw_only=True)
class CleanOptions(SceneOptions):
    """Remove Gaussians of a splat that make its photographs worse or that none of them needs.

    No photograph loses more than 0.01 dB. Without SCENE, remove those that stand out from their
    neighbours: isolated, huge, needles, transparent. `gscompleter strip` puts all back.
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None  # type: ignore[assignment]
    """Folder of the photographs, as in `complete`; if not given, neighbours decide."""
    out: Path
    """Folder for completed.ply, removed.ply and summary.json."""
    scene: Path
    """File of Gaussians to clean."""
    dry_run: bool = False
    """Write only removed.ply, the Gaussians that would go, and summary.json."""
    device: Device = "auto"
    """Device to compare photographs on."""
    config: CleaningConfig = CleaningConfig()


@dataclass(frozen=True, kw_only=True)
class DemoOptions(RunOptions, WritingOptions):
    """Complete the stereo pair that scikit-image contains, and show before and after."""

    out: Path = Path("demo")
    """Folder for the scene, its completion and before_after.png."""


@dataclass(frozen=True, kw_only=True)
class EngineOptions(Options):
    """Options of every command that can run on several machines."""

    engine: EngineName | None
    workers: Annotated[int, Interval(ge=1, le=100_000)] | None = None
    """Number of workers; as many as fit if not given (one with SLURM)."""
    threads: Threads | None = None
    """CPU threads of each worker; an equal share of this machine's cores, or one elsewhere."""
    address: str | None = None
    """Address of a running Ray cluster; a cluster is started here if not given."""
    gpus: Annotated[float, Interval(ge=0, le=1024)] = 0.0
    """GPUs per worker with Ray (also fractions) or SLURM."""
    slurm: tuple[str, ...] = ()
    """Parameters for SLURM with --engine submitit, as in --slurm partition=gpu time=120."""
    shard: str | None = None
    """Run every n-th job or case from the i-th on, given as i/n with i from 0; `auto` takes both
    from a SLURM array."""


@dataclass(frozen=True, kw_only=True)
class BatchOptions(EngineOptions):
    """Complete many scenes, on several processes or machines.

    Run the same command again to continue. OUT contains a folder per scene in jobs/, table.csv
    (with the reason where a scene could not be completed) and index.html.
    """

    manifest: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")]
    """A .csv or .jsonl file with a row per scene, whose columns are `folder` (SCENE, relative to
    the file), `name` and options of `complete`; or a folder of scenes."""
    out: Path
    """Folder for the results; a folder of an earlier run is continued."""
    engine: EngineName = "local"
    """Engine that runs the jobs: processes of this machine, Ray, or SLURM."""
    retries: Annotated[int, Interval(ge=0, le=100)] = 2
    """Further attempts for a job that was killed or that failed unexpectedly."""
    rerun: Literal["nothing", "failures"] = "nothing"
    """Jobs of an earlier run to repeat: none, or those that failed."""
    each: tuple[str, ...] = ()
    """Options of `complete` for every row that does not set them, as in --each resolution=256."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(SynthesisOptions, EngineOptions):
    """Run methods on cases with known target photographs, and score them.

    Run the same command again to continue. `gscompleter tables OUT` writes the tables at any time.
    With a preset, a table, a figure or several reconstructors it writes tables and figures of the
    paper instead.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A cases.json; or, with --protocol, scenes: folders with a transforms.json, folders of such
    folders, pixelSplat chunks, RealEstate10K camera files, or drives (Waymo, nuScenes, KITTI, DDAD,
    PandaSet; front camera)."""
    out: Path
    """Folder for the results; a folder of an earlier run is continued."""
    protocol: tuple[str, ...] = ()
    """Choice of context and target frames; one or several of: n-10 (frames n and n + 10 for n + 20,
    then n + 20 and n + 10 for n, for n = 0, 21, 42, …); stress (0 and 30 for 99) or stress-12-39
    (0 and 12 for 39); sequence-4 or sequence-4-steps-6 (start from frames 0 and 4, then complete 8,
    12, … one after the other); or an evaluation index, by its path or as dl3dv-n-10, re10k-n-30,
    acid-n-30 or dl3dv-stress, which are ours. A cases.json needs none."""
    methods: tuple[str, ...] = ("context", "full", "paper")
    """Methods to compare: context, full, paper, an ablation such as no-sa, densify-100,
    densify-800, distill, reggs; or a group: ablations, baselines, all. Tables and figures of the
    paper have their own."""
    preset: Literal["re10k", "acid", "dl3dv", "waymo"] | None = None
    """Data set of the paper, which sets protocol, resolution, near, far, reconstructors and
    generator where they are not given. At its own resolution photographs are cropped, and scenes
    left out, as by the code of the models' authors."""
    table: tuple[TableName, ...] = ()
    """Tables of the paper to write; `all` leaves out those that need another generator."""
    figure: tuple[FigureName, ...] = ()
    """Figures of the paper to draw."""
    figure_cases: tuple[str, ...] = ()
    """Cases of the figures, named as in the tables; by default the first eight."""
    outlines: bool = False
    """Outline the holes in figures."""
    crops: bool = False
    """Show the widest hole of each case in figures magnified."""
    reconstructor: tuple[str, ...] = ()
    """Models that turn photographs into Gaussians: plane-sweep (the default), or one or several of
    `gscompleter models`."""
    weights: tuple[Path, ...] = ()
    """Weights file of each reconstructor, or NAME=FILE for some of them, as in
    mvsplat-re10k=re10k.ckpt; others are downloaded."""
    synthesis: Annotated[GeneratorOptions, tyro.conf.OmitArgPrefixes] = GeneratorOptions(AUTO)
    near: float | None = None
    """Smallest depth in the scenes, in the unit of their cameras; by default that of the data, or
    else of the model's authors."""
    far: float | None = None
    """Largest depth in the scenes; by default as for near."""
    rerun: Literal["nothing", "failures", "scores"] = "nothing"
    """Cases of an earlier run to repeat: those that failed, or all scores."""
    engine: EngineName | None = None
    """Engine of `batch` that runs the cases; this process if not given."""
    resolution: Size | None = None
    """Working size as in `complete`; by default that of the cases."""
    masks: bool = True
    """Ignore the pixels that masks (black) or alpha channels (transparent) hide, in the methods and
    in the scores."""
    ignore_moving: bool = False
    """Ignore boxes of moving objects in the same way (Waymo, nuScenes)."""
    one_per_scene: bool = False
    """Run only the first case of each scene and protocol, as the paper does."""
    ego_mask: bool = True
    """Ignore what stays the same while the camera moves, such as the bonnet of its car."""
    limit: Annotated[int, Interval(ge=1)] | None = None
    """Most cases to run, over all shards."""


@dataclass(frozen=True, kw_only=True)
class TablesOptions(Options):
    """Print and write the tables of an evaluation, finished or not."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `evaluate`; the tables are written there."""
    fid: bool = False
    """Also compute the FID of each method."""


@dataclass(frozen=True, kw_only=True)
class IndexOptions(WritingOptions):
    """Write the frames that a protocol selects in a data set."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Scenes as in `evaluate`."""
    protocol: str
    """Protocol as in `evaluate`."""
    out: Path
    """JSON file for the evaluation index."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions(RunOptions, WritingOptions):
    """Measure how long completions take on this machine and how the time grows.

    Every completion is a process of its own, start-up included. Times are also given relative to
    one pass of the renderer, forward and backward, with 196,608 Gaussians at 256 x 256. Without
    cases the pair of `demo` is measured.
    """

    cases: Path | None = None
    """JSON file of scenes with their frames and growth series, as benchmarks/performance.json."""
    in_process: bool = False
    """Run all completions in this process, as a program does that uses the library."""
    generators: tuple[str, ...] = ()
    """Compare these generators instead, at the first target of each case: seconds, and scores in
    holes."""
    growth: tuple[Axis, ...] = ("gaussians", "pixels", "views", "targets")
    """Quantities to increase in the first case."""
    repeats: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Number of repetitions."""
    quick: bool = False
    """Run a quick check: the smallest case once, no growth."""
    json: bool = False
    """Print all measurements as JSON instead of tables."""
    out: Path | None = None
    """Folder for bench.json and tables.md."""


@dataclass(frozen=True, kw_only=True)
class ModelsOptions(Settings):
    """List published model weights with their licences, and show which are downloaded."""

    download: tuple[str, ...] = ()
    """Names of the list, whose files are downloaded and verified first."""
    json: bool = False
    """Print all details as JSON."""


@dataclass(frozen=True, kw_only=True)
class PosesOptions(ComputeOptions, WritingOptions):
    """Find the cameras of photographs with COLMAP, and write a COLMAP folder.

    A second run with the same photographs or video keeps the result.
    """

    photographs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of overlapping photographs or 360° panoramas (2:1) of one scene, or a video. They are
    not changed."""
    frames: NumFrames = 40
    """Most frames of a video to take as photographs, sharp ones at even steps of the camera."""
    out: Path
    """Output folder: upright copies in images, cameras and points in sparse/0."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(WritingOptions):
    """Convert a file of Gaussians to another format, by the name of B.

    Formats are .ply, .compressed.ply, .spz, .splat, .sog, .glb (KHR_gaussian_splatting), and
    .usda, .usdc and .usdz (OpenUSD, with usd-core). It also reads .ksplat and the folder of a .sog.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    plain: bool = False
    """Write no labels of generated Gaussians, which some programs misread: no property `generated`
    in a .ply, no file beside other formats."""


@dataclass(frozen=True, kw_only=True)
class StripOptions(WritingOptions):
    """Undo a completion: remove what was generated and put the originals back."""

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """Completed scene. Gaussians of a removed.ply beside it are put back."""
    out: Path
    """File for the original scene."""


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """Write report.html of a completion again."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Output folder of `complete` or `demo`."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(WritingOptions):
    """Show a scene before and after its completion in the browser.

    Side by side, with a slider, or one at a time; generated Gaussians can be tinted or hidden.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """Output folder of `complete`, or a file of Gaussians in any format that `convert` reads."""
    other: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="B")] = None
    """The scene after, if A is the one before; by default A with its generated Gaussians."""
    cameras: Path | None = None
    """Cameras to jump to: a file as in `complete --target`, or a folder with a transforms.json or a
    COLMAP model; in the coordinates of the photographs if A is an output folder, else of A."""
    resolution: tuple[int, int] | None = None
    """Image size (height and width) of cameras whose file has none."""
    save: Path | None = None
    """Write the page to this file instead of serving it."""
    port: Port = 0
    """Port of the page on 127.0.0.1; a free one if not given."""
    no_open: bool = False
    """Print the address without opening a browser."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(ComputeOptions):
    """Compile all kernels for this type of processor into numba's cache (NUMBA_CACHE_DIR)."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(Settings):
    """Print what is installed, and for what is missing its purpose and what to do."""

    json: bool = False
    """Print the result as JSON."""


def list_inputs(options: Settings) -> list[Path]:
    """List the paths that a command reads: those of all its options but the outputs."""
    inputs: list[Path] = []
    for name, value in vars(options).items():
        values = value if isinstance(value, tuple) else (value,)
        if name in WORDS_OR_PATHS:
            inputs += [Path(word) for word in values if isinstance(word, str)]
        elif isinstance(value, Settings):
            inputs += list_inputs(value)
        elif name not in OUTPUTS:
            inputs += [path for path in values if isinstance(path, Path)]
    return inputs


def get_max_targets(options: CompleteOptions) -> int:
    """Return the number of targets to search for."""
    return DEFAULT_NUM_TARGETS if options.auto is None else options.auto


def parse_resolution(given: Size | None) -> tuple[int, int] | int | None:
    """Return `--resolution` as the readers of photographs take it."""
    size = LONG_SIDE if given is None else given
    return None if size == "full" else size
