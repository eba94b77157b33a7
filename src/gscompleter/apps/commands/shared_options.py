"""Options that several commands share. Nothing here needs torch."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro
from annotated_types import Interval

from gscompleter.apps.command_line.chosen_config import ChosenConfig
from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.apps.requests.scene import FRAME_NUMBER, Names, Size
from gscompleter.config import SourceDepthName
from gscompleter.config.generators import GeneratorOptions
from gscompleter.config.settings import Device, Seed, Settings
from gscompleter.data.sfm import NUM_VIDEO_FRAMES
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.jobs.engine_names import EngineName

ChosenPhotographs = Annotated[Names | None, tyro.conf.arg(metavar="PHOTO [PHOTO ...]")]
"""File names of photographs, or their numbers."""
Threads = Annotated[int, Interval(ge=1, le=1024)]
Port = Annotated[int, Interval(ge=0, le=65535)]
NumFrames = Annotated[int, Interval(ge=3, le=1000)]
OUTPUTS = ("out", "save", "export_holes")
"""Options that name what a command writes."""
WORDS_OR_PATHS = ("target", "protocol", "generator_weights", "generator_depth")
"""Options whose words may be paths of files or folders that are read. Other words are counted as
paths, too, which do not exist. Functions (file.py:function) and configs (YAML) are not: no command
writes over these."""
ADDRESS = re.compile(r"\w\w+:/")
"""Beginning of an address such as s3://bucket; a path makes one of its two slashes. It has two
letters at least, since `C:/results` is a path of Windows."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Options of every command that writes something."""

    quiet: bool = False
    """Print errors only, and what --json asks for."""
    json: bool = False
    """Print the result as JSON."""

    @property
    def answer(self) -> AnswerRequest:
        """Return what the command prints."""
        return AnswerRequest(self.quiet, self.json)

    def refuse_addresses(self) -> None:
        """Raise an InputError if an output is an address, which would become folders here."""
        for name in OUTPUTS:
            out = getattr(self, name, None)
            if isinstance(out, Path) and ADDRESS.match(out.as_posix()):
                raise InputError(
                    f"{quote_value(out)} is an address, and results are written to a disk; name a "
                    "path.",
                    name.replace("_", "-"),
                )

    def check_overlap(self) -> None:
        """Raise an InputError if the output of the command is, holds or lies in an input."""
        out = getattr(self, "out", None)
        if isinstance(out, Path):
            refuse_overlap(out, list_inputs(self))


@dataclass(frozen=True, kw_only=True)
class WritingOptions(Options):
    """Options of every command that replaces earlier results on request only."""

    overwrite: bool = False
    """Replace an existing file, or what an earlier run wrote in the output folder."""


@dataclass(frozen=True, kw_only=True)
class ComputeOptions(Options):
    """Options of every command that computes for long."""

    threads: Threads | None = None
    """CPU threads to compute with. All available cores if not given."""


@dataclass(frozen=True, kw_only=True)
class DeviceOptions(Settings):
    """The option of every command that draws."""

    device: Device = "auto"
    """Device to compute on. `auto` draws on an NVIDIA GPU if gsplat can, and runs networks on any
    GPU that torch sees; `mps` runs networks on the GPU of a Mac and draws on the CPU."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(ComputeOptions, DeviceOptions):
    """Options of every command that completes scenes."""

    seed: Seed = 0
    """Seed of all random numbers. The same seed gives the same files on CPUs of one type."""


@dataclass(frozen=True, kw_only=True)
class DepthOptions(RunOptions):
    """Options of every command with a choice of monocular depth."""

    depth: str = "none"
    """Monocular depth that helps plane-sweep where stereo measures nothing. It is none, moge-2,
    another of docs/models.md, or a function of yours as file.py:function."""
    depth_weights: Path | None = None
    """Weights of that depth. A file; downloaded if not given."""
    renderer_device: Literal["cpu", "cuda"] | None = None
    """Device of the renderer and the photographs; as `--device` if not given."""
    network_device: Literal["cpu", "cuda", "mps"] | None = None
    """Device of the networks and of plane-sweep alone: cuda for GPUs of NVIDIA and AMD, mps for
    those of a Mac, which run networks only; as `--device` if not given."""


@dataclass(frozen=True, kw_only=True)
class SynthesisOptions(DepthOptions):
    """Options of every command with a choice of the generator."""

    synthesis: Annotated[GeneratorOptions, tyro.conf.OmitArgPrefixes] = GeneratorOptions()


@dataclass(frozen=True, kw_only=True)
class ReconstructorOptions(DepthOptions):
    """Options of every command with a choice of one reconstructor."""

    reconstructor: str = "plane-sweep"
    """Model that turns photographs into Gaussians. Also one of `gscompleter models`, or a function
    of yours as file.py:function."""
    weights: Path | None = None
    """Weights of the reconstructor. A file; downloaded if not given."""


@dataclass(frozen=True, kw_only=True)
class ModelOptions(ReconstructorOptions, SynthesisOptions):
    """Options of every command with a choice of models."""


@dataclass(frozen=True, kw_only=True)
class MaskOptions(Settings):
    """Options of every command that reads masks."""

    invert_masks: bool = False
    """Read masks the other way round: those of what goes if there are any, or else those of
    photographs (white is then ignored)."""
    large_masks: bool = False
    """Go on with masks that take away more than half of images or of the splat."""


@dataclass(frozen=True, kw_only=True)
class GeometryOptions(Settings):
    """The option of every command that takes depth from elsewhere."""

    geometry: Path | None = None
    """Mesh or points, such as a laser scan (.ply, .obj, .glb), in the frame of the scene or in one
    of its own, from which it is moved to where the scene shows the same. It gives depth where
    photographs show none, as far as it agrees with what these show."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ComputeOptions, WritingOptions, MaskOptions):
    """Options of every command that opens photographs with cameras."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder of the photographs of the splat, in any layout that `complete` reads."""
    frames: NumFrames = NUM_VIDEO_FRAMES
    """Most frames of a video to take as photographs, sharp ones at even steps of the camera."""
    context: ChosenPhotographs = None
    """Photographs to work with: file names, or numbers from 0 in the order of the file paths. If
    not given, those that help most; photographs of targets are never used."""
    out: Path
    """Write results here. A folder, for completed.ply, the report (report.html), images and
    summary.json."""
    format: str | None = None
    """Format of SCENE: colmap, nerfstudio, cameras-json, llff, kitti, kitti-raw, dgp, waymo,
    mmdet3d, pandaset, chunks, real-estate-10k, polycam, record3d, 3d-scanner-app, scannet, replica,
    mvsnet, idr or photograph. Detected if not given."""
    scene: Path | None  # each command has its own help and default
    resolution: Size | None = None
    """Size of images in pixels. The working size: longest side (photographs are never enlarged),
    or height and width (scaled and cropped), or `full`. If not given, 640, or that of the splat's
    training if smaller."""
    near: float | None = None
    """Smallest depth in the scene, in the unit of its cameras. If not given, that of the data or of
    the model's authors, or else estimated. It is brought forward, and a line says so, if the
    photographs show nearer surfaces."""
    far: float | None = None
    """Largest depth in the scene, in the unit of its cameras. Else as for near."""
    no_given_depth: bool = False
    """Ignore the depth that SCENE holds: depth maps, laser sweeps, COLMAP's points."""
    no_refine_poses: bool = False
    """Keep the given poses of photographs; else those that matches contradict are refined."""
    no_masks: bool = False
    """Use what masks and alpha channels of photographs hide instead of ignoring it."""
    ignore: Path | None = None
    """Folder of masks of what to leave out of photographs: images named as these, white there. In
    place of masks beside photographs (black there)."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    forget_edits: bool = False
    """Forget earlier edits: photographs may bring back what was removed or marked as wrong, and no
    scene is made anew."""
    ignore_properties: bool = False
    """Go on with a splat whose further properties change what is seen, such as a moving one."""


@dataclass(frozen=True, kw_only=True)
class CompletingOptions(SceneOptions, ModelOptions, GeometryOptions):
    """Options of the commands that complete one scene."""

    # May be left out, unlike that of `SceneOptions`.
    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None  # type: ignore[assignment]
    """Folder of the photographs: COLMAP, nerfstudio, cameras.json, LLFF, KITTI, DGP, Waymo,
    PandaSet, ScanNet, Replica, MVSNet, IDR, a pixelSplat chunk, a RealEstate10K camera file, or
    what Polycam, Record3D or 3d Scanner App exports. If it has no cameras, COLMAP finds them and
    they are kept in OUT/colmap; also of 360° panoramas (2:1) and of a video (.mp4, .mov, .mkv). One
    image needs none. A splat without photographs may be SCENE itself."""
    scene: Path | None = None
    """File of Gaussians (a splat) to work on. It is of these photographs, and completed instead of
    reconstructing the scene; all are kept, but what earlier commands added gives way where
    photographs show something else."""
    cameras: Path | None = None
    """Cameras to look at the splat from: a file as in `complete --target`. If there are no
    photographs, renders at some of them take their place. If not given, a cameras.json beside the
    splat, or cameras that are found around the targets."""
    up: tuple[float, float, float] | None = None
    """Upward direction of the splat: x, y and z in its file (in the axes of a .ply). For cameras
    that are found. If not given, what its file or the cameras beside it say, else its floor, else
    -y."""
    holes: Literal["auto", "all", "enclosed"] = "auto"
    """Holes to fill: all that is empty, or only what the splat encloses, as in an object that
    stands on nothing, outside of which nothing is added. `auto` tells an object without photographs
    by what is around it."""
    no_recolor: bool = False
    """Keep the colours of the splat, too; Gaussians are only added."""
    config: Annotated[ChosenConfig, tyro.conf.FlagConversionOff] = ChosenConfig()
    """Settings of the method, which change those of `--config NAME`."""


@dataclass(frozen=True, kw_only=True)
class EngineOptions(Options):
    """Options of every command that can run on several machines."""

    engine: EngineName | None  # each command has its own help and default
    workers: Annotated[int, Interval(ge=1, le=100_000)] | None = None
    """Number of workers; as many as fit if not given (one with SLURM)."""
    threads: Threads | None = None
    """CPU threads to compute with. Of each worker; an equal share of this machine's cores if not
    given, or one elsewhere."""
    address: str | None = None
    """Address of a running Ray cluster; a cluster is started here if not given."""
    gpus: Annotated[float, Interval(ge=0, le=1024)] = 0.0
    """GPUs per worker with Ray (also fractions) or SLURM."""
    slurm: tuple[str, ...] = ()
    """Parameters for SLURM with --engine submitit, as in --slurm partition=gpu time=120."""
    shard: str | None = None
    """Run every n-th job or case from the i-th on, given as i/n with i from 0; `auto` takes both
    from a SLURM array."""


def list_inputs(options: Settings) -> list[Path]:
    """List the paths that a command reads: those of its options but the outputs.

    Of words, those are left out that no command reads as a path, whatever the working folder holds.
    """
    inputs: list[Path] = []
    for name, value in vars(options).items():
        values = value if isinstance(value, tuple) else (value,)
        if name in WORDS_OR_PATHS:
            words = [word for word in values if isinstance(word, str)]
            inputs += [Path(word) for word in words if may_be_path(name, word)]
        elif isinstance(value, Settings):
            inputs += list_inputs(value)
        elif name not in OUTPUTS:
            inputs += [path for path in values if isinstance(path, Path)]
    return inputs


def may_be_path(name: str, word: str) -> bool:
    """Return True if a word of one of `WORDS_OR_PATHS` may be a path.

    A number is a photograph, and what is no file is the name of a protocol.
    """
    if name == "protocol":
        return os.path.isfile(word)
    if name == "generator_depth":
        return word not in get_args(SourceDepthName)
    return FRAME_NUMBER.fullmatch(word) is None


def refuse_size_alone(resolution: tuple[int, int] | None, cameras: Path | None) -> None:
    """Raise InputError for a size of images without `--cameras`, whose images it is."""
    if resolution is not None and cameras is None:
        raise InputError(
            "--resolution is the size of images at --cameras; name their file, or leave it out.",
            "cameras",
        )


def replace_by_scenes(inputs: Sequence[Path], data: Sequence[Path]) -> list[Path]:
    """Replace the paths of `data` among the inputs by their scenes, beside which results may lie.

    A file that names scenes or cases stays, and the scenes that it names are added.
    """
    from gscompleter.apps.evaluating.cases import list_data  # it needs torch, no help waits for it

    scenes = {path: list_data(path) for path in data}
    return [scene for path in inputs for scene in scenes.get(path, [path])]
