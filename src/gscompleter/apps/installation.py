"""Check of the installation: packages, devices and compiled kernels of this machine."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit
from urllib.request import url2pathname

import torch
from packaging.requirements import Requirement

from gscompleter.apps.viewer.packages import BUILT_LIBRARIES, LOCK_FILE, get_archive_path, read_lock
from gscompleter.apps.warmup import PARTS
from gscompleter.models.weights.fetching import find_cached
from gscompleter.models.weights.published import PUBLISHED, PublishedWeights
from gscompleter.numerics.kernels.cache import CACHE
from gscompleter.numerics.kernels.compiled import get_cache_folder, is_compiled
from gscompleter.render.device import choose_device
from gscompleter.render.gsplat_kernels import explain_missing_gpu
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.downloads import get_download_folder
from gscompleter.system.machine import describe_machine
from gscompleter.types import Camera, Gaussians, make_observed, sh_from_rgb

PURPOSES = {
    "cuda": "rendering on an NVIDIA GPU",
    "metal": "rendering on the GPU of a Mac, from Python",
    "evaluation": "the plots of evaluate and tables, FLIP, LPIPS, ST-LPIPS and FID",
    "models": "downloading published weights from the Hugging Face hub",
    "diffusion": "--generator pe-field and diffusers-inpaint",
    "onnx": "--generator migan and lama, and --depth moge-2",
    "poses": "photographs whose cameras are not known",
    "features": "cameras of photographs too far apart for SIFT",
    "browser": "the picture of the viewer in the documentation",
    "film": "videos as SCENE, and complete --video",
    "ray": "batch --engine ray",
    "slurm": "batch --engine submitit",
    "waymo": "the Waymo Open Dataset 2, whose tables are parquet",
    "phones": "the depth of Record3D",
    "heic": "photographs as HEIC, as iPhones take them",
    "usd": "splats as OpenUSD (.usda, .usdc, .usdz)",
}
"""Purpose of each extra, without those for developers (`test-core`, `test`, `dev`, `docs`)."""

CPU_BUILD = "--index-url https://download.pytorch.org/whl/cpu"
"""Option of pip for the CPU build of torch. Named as an extra index, beside the usual one, pip may
pass over it in silence."""
PACKAGE = "gscompleter"
WEIGHT_USES: dict[str, Callable[[PublishedWeights], bool]] = {
    "reconstructor": lambda published: published.is_reconstructor,
    "depth": lambda published: published.gives == "monocular depth",
    "generator": lambda published: published.gives == "image",
}
"""Options that take published weights, with those that they take."""
TEST_SIZE = 16
"""Width and height, in pixels, of the picture that each renderer draws."""
MIN_TEST_ALPHA = 0.5
"""Smallest alpha in the middle of that picture, where an opaque Gaussian is."""


@dataclass(frozen=True)
class Found:
    """One line of the result."""

    kind: str
    name: str
    there: bool
    """True for what is installed and works, and False for what is missing."""
    told: str
    """Versions and locations, or the purpose of a missing part."""
    install: str | None = None
    """Command that installs a missing part; None if it is there, or if there is no command."""


def check_needs(extras: Sequence[str]) -> None:
    """Refuse names that are no extras."""
    for extra in extras:
        if extra not in PURPOSES:
            raise InputError(
                f"There is no extra '{quote_value(extra)}'; choose from {', '.join(PURPOSES)}.",
                "needs",
            )


def inspect_installation() -> Iterator[Found]:
    """Inspect all parts, in the order of the result."""
    for name, value in describe_machine(choose_device()).items():
        yield Found("machine", name, True, str(value))

    if not is_installed():
        told = "it runs from a folder and is not installed, so that what it needs is not known"
        yield Found("packages", PACKAGE, False, told)
    for requirement in list_requirements():
        version = find_installed_version(requirement)
        if version is None:
            told = "every command needs it"
            install = f"pip install {shlex.quote(str(requirement))}"
            yield Found("packages", requirement.name, False, told, install)
        else:
            yield Found("packages", requirement.name, True, describe_build(requirement, version))
    for extra, purpose in PURPOSES.items():
        yield inspect_extra(extra, purpose)

    for name in ("cpu", "cuda", "metal", "reference"):
        yield inspect_renderer(name)
    yield inspect_kernels()
    for option, takes in WEIGHT_USES.items():
        yield inspect_weights(option, [p for p in PUBLISHED.values() if takes(p)])

    # A wheel contains the libraries in one file; a checkout downloads an archive of each.
    archives = [get_archive_path(package) for package in read_lock(LOCK_FILE)]
    there = BUILT_LIBRARIES.is_file() or all(path.is_file() for path in archives)
    told = "here" if there else "fetched from npm's registry when a page is first made"
    command = None if there else "gscompleter view OUT"
    yield Found("viewer", "libraries", there, told, command)

    yield Found("caches", "downloads", True, f"{get_download_folder()} (GSCOMPLETER_HOME)")
    yield inspect_kernel_cache()
    yield Found("caches", "torch.hub", True, f"{torch.hub.get_dir()} (TORCH_HOME)")


def describe_build(requirement: Requirement, version: str) -> str:
    """Describe an installed package; torch with the libraries of CUDA says if it sees no GPU."""
    missing = explain_missing_gpu()
    if requirement.name != "torch" or not torch.version.cuda or missing is None:
        return version
    return (
        f"{version} (built for CUDA, and {missing}; where there is none, the CPU build is "
        f"gigabytes smaller: pip install --force-reinstall torch {CPU_BUILD})"
    )


def inspect_renderer(name: str) -> Found:
    """Draw a picture with a renderer: it can be installed and lack its GPU or its kernels."""
    try:
        renderer = load_renderer(name)
    except InputError as error:
        return Found("renderers", name, False, str(error))
    try:
        alpha = renderer.render(*make_test_scene("cuda" if name == "cuda" else "cpu")).alpha
    # Whatever a driver or a compiler raises, doctor says it and goes on.
    except Exception as error:
        first_line = str(error).strip().partition("\n")[0]
        return Found("renderers", name, False, f"{type(error).__name__}: {first_line}")
    middle = float(alpha[TEST_SIZE // 2, TEST_SIZE // 2])
    if not middle > MIN_TEST_ALPHA:
        return Found("renderers", name, False, f"draws nothing: alpha {middle:.2f} in the middle")
    return Found("renderers", name, True, "draws here")


def make_test_scene(device: str) -> tuple[Gaussians, Camera]:
    """Create one opaque white Gaussian, and a camera that sees it in the middle of its image."""
    gaussian = make_observed(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.2),
        opacities=torch.tensor([0.99]),
        sh=sh_from_rgb(torch.ones(1, 3)),
    )
    half = TEST_SIZE / 2
    K = torch.tensor(
        [[float(TEST_SIZE), 0.0, half], [0.0, float(TEST_SIZE), half], [0.0, 0.0, 1.0]]
    )
    camera = Camera(torch.eye(4), K, TEST_SIZE, TEST_SIZE, near=1.0, far=4.0)
    return gaussian.to(device), camera.to(device)


def inspect_kernels() -> Found:
    """Inspect whether all kernels are compiled; without a cache they never stay so."""
    if CACHE.folder is None:
        return Found("renderers", "kernels", False, "compiled again in each run")
    if all(is_compiled(part) for part in PARTS):
        return Found("renderers", "kernels", True, "compiled")
    told = "compiled by the first completion, or in advance"
    return Found("renderers", "kernels", False, told, "gscompleter warmup")


def inspect_weights(option: str, published: Sequence[PublishedWeights]) -> Found:
    """Inspect the published weights that an option takes."""
    # One file is enough to count as there: nobody needs all of them.
    here = [weights.name for weights in published if find_cached(weights)]
    names = ", ".join(here) or f"all {len(published)} that `gscompleter models` lists"
    command = None if here else "gscompleter models --download NAME"
    return Found("weights", f"{option}s", bool(here), f"{names}, for --{option}", command)


def inspect_kernel_cache() -> Found:
    """Inspect the folder of compiled kernels; a note says why it is not the usual one."""
    if CACHE.note is not None:
        return Found("caches", "kernels", False, CACHE.note)
    return Found("caches", "kernels", True, f"{get_cache_folder()} (NUMBA_CACHE_DIR)")


def inspect_extra(extra: str, purpose: str) -> Found:
    """Inspect the packages of an extra, and what these need of their own extras."""
    requirements = list_requirements(extra)
    if not is_installed():
        return Found("extras", extra, False, f"its packages are not known; for {purpose}")
    # No requirement at all: an older version of the package does not know the extra, or its markers
    # leave out this version of Python.
    if not requirements:
        detail = f"the installed version or this Python is older than this extra; for {purpose}"
        return Found("extras", extra, False, detail)
    missing = list_missing(requirements)
    if missing:
        detail = f"{', '.join(missing)}, for {purpose}"
        return Found("extras", extra, False, detail, make_install_command(extra))
    versions = [f"{one.name} {find_installed_version(one)}" for one in requirements]
    return Found("extras", extra, True, f"{', '.join(versions)}, for {purpose}")


def list_missing(requirements: Sequence[Requirement]) -> list[str]:
    """List the names of missing packages, those included that extras of others bring."""
    missing: list[str] = []
    waiting = [*requirements]
    seen = set()
    while waiting:
        requirement = waiting.pop(0)
        if str(requirement) in seen:
            continue
        # Extras may name each other.
        seen.add(str(requirement))
        if find_installed_version(requirement) is None:
            missing.append(requirement.name)
            continue
        for extra in sorted(requirement.extras):
            waiting += list_requirements(extra, requirement.name)
    return list(dict.fromkeys(missing))


def make_install_command(extra: str) -> str:
    """Make the command that adds an extra to the package as it was installed.

    A checkout, a wheel or a repository was named by its place, and the package index need not have
    this version.
    """
    try:
        text = importlib.metadata.distribution(PACKAGE).read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        text = None
    source = json.loads(text) if text else {}
    url = source.get("url")
    named = f"{PACKAGE}[{extra}]"
    if url is None:
        return f"pip install {shlex.quote(named)}"
    if "dir_info" in source:
        editable = "-e " if source["dir_info"].get("editable") else ""
        folder = url2pathname(urlsplit(url).path)
        return f"pip install {editable}{shlex.quote(f'{folder}[{extra}]')}"
    if "vcs_info" in source:
        url = f"{source['vcs_info']['vcs']}+{url}@{source['vcs_info']['commit_id']}"
    if "subdirectory" in source:
        url += f"#subdirectory={source['subdirectory']}"
    return f"pip install {shlex.quote(f'{named} @ {url}')}"


def is_installed() -> bool:
    """Return True if the package is installed, so that its requirements are known."""
    try:
        importlib.metadata.distribution(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def list_requirements(extra: str = "", package: str = PACKAGE) -> list[Requirement]:
    """List the requirements of a package, or those that an extra of it adds; none if unknown."""
    try:
        lines = importlib.metadata.requires(package) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    requirements = [Requirement(line) for line in lines]
    return [requirement for requirement in requirements if is_required_by(extra, requirement)]


def is_required_by(extra: str, requirement: Requirement) -> bool:
    """Return True if an extra adds this requirement; without a name, if all need it."""
    # A marker that holds without an extra, such as one for a platform, belongs to the package.
    if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
        return not extra
    return bool(extra) and requirement.marker.evaluate({"extra": extra})


def find_installed_version(requirement: Requirement) -> str | None:
    """Return the installed version if it satisfies the requirement."""
    try:
        version = importlib.metadata.version(requirement.name)
    except importlib.metadata.PackageNotFoundError:
        return None
    # A pre-release, as nightly builds of torch are, counts by its number alone.
    return version if requirement.specifier.contains(version, prereleases=True) else None
