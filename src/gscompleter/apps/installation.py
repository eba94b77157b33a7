"""Check of the installation: packages, devices and compiled kernels of this machine."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit
from urllib.request import url2pathname

import torch
from packaging.requirements import Requirement

from gscompleter.apps.viewer.packages import BUILT_LIBRARIES, LOCK_FILE, get_archive_path, read_lock
from gscompleter.apps.warmup import PARTS
from gscompleter.models.weights.fetching import find_cached
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.numerics.kernels.cache import CACHE
from gscompleter.numerics.kernels.compiled import get_cache_folder, is_compiled
from gscompleter.render.device import choose_device
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.writing import get_download_folder
from gscompleter.system.machine import describe_machine
from gscompleter.types import Camera, Gaussians, make_observed, sh_from_rgb

PURPOSES = {
    "cuda": "rendering on an NVIDIA GPU",
    "metal": "rendering on the GPU of a Mac, from Python",
    "evaluation": "the plots of evaluate and tables, FLIP, LPIPS, ST-LPIPS and FID",
    "models": "downloading published weights from the Hugging Face hub",
    "diffusion": "--generator pe-field and diffusers-inpaint",
    "onnx": "--generator migan and lama",
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
"""Option of pip for the CPU build of torch; as a further index pip may pass over it in silence."""
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

    for requirement in list_requirements():
        version = find_installed_version(requirement)
        if version is None:
            told = "every command needs it"
            yield Found("packages", requirement.name, False, told, f"pip install '{requirement}'")
        else:
            yield Found("packages", requirement.name, True, describe_build(requirement, version))
    for extra, purpose in PURPOSES.items():
        yield inspect_extra(extra, purpose)

    for name in ("cpu", "cuda", "metal", "reference"):
        yield inspect_renderer(name)
    compiled = all(is_compiled(part) for part in PARTS)
    yield Found(
        "renderers",
        "kernels",
        compiled,
        "compiled" if compiled else "compiled by the first completion, or in advance",
        None if compiled else "gscompleter warmup",
    )

    # One file of weights is enough to count as there: nobody needs all of them.
    here = [name for name, published in PUBLISHED.items() if find_cached(published)]
    weights = ", ".join(here) or f"all {len(PUBLISHED)} that `gscompleter models` lists"
    command = None if here else "gscompleter models --download NAME"
    yield Found("weights", "reconstructors", bool(here), f"{weights}, for --reconstructor", command)

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
    """Describe an installed package; torch with the libraries of CUDA says so where no GPU is."""
    if requirement.name != "torch" or not torch.version.cuda or torch.cuda.is_available():
        return version
    return (
        f"{version} (built for CUDA, and there is no GPU; gigabytes smaller is the CPU build: pip "
        f"install --force-reinstall torch {CPU_BUILD})"
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


def inspect_kernel_cache() -> Found:
    """Inspect the folder of compiled kernels; a note says why it is not the usual one."""
    if CACHE.note is not None:
        return Found("caches", "kernels", False, CACHE.note)
    return Found("caches", "kernels", True, f"{get_cache_folder()} (NUMBA_CACHE_DIR)")


def inspect_extra(extra: str, purpose: str) -> Found:
    """Inspect the packages of an extra."""
    versions = {
        requirement.name: find_installed_version(requirement)
        for requirement in list_requirements(extra)
    }
    missing = [name for name, version in versions.items() if version is None]
    # No requirement at all: an older version of the package does not know the extra, or its markers
    # leave out this version of Python.
    if not versions:
        detail = f"the installed version or this Python is older than this extra; for {purpose}"
    elif missing:
        detail = f"{', '.join(missing)}, for {purpose}"
        return Found("extras", extra, False, detail, make_install_command(extra))
    else:
        names = ", ".join(f"{name} {version}" for name, version in versions.items())
        detail = f"{names}, for {purpose}"
    return Found("extras", extra, bool(versions), detail)


def make_install_command(extra: str) -> str:
    """Make the command that adds an extra to the package as it was installed.

    A checkout or a wheel was named by its place, and the package index need not have this version.
    """
    try:
        text = importlib.metadata.distribution("gscompleter").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        text = None
    source = json.loads(text) if text else {}
    url = source.get("url", "")
    if not url.startswith("file:"):
        return f"pip install 'gscompleter[{extra}]'"
    if "dir_info" not in source:
        return f"pip install 'gscompleter[{extra}] @ {url}'"
    editable = "-e " if source["dir_info"].get("editable") else ""
    folder = url2pathname(urlsplit(url).path)
    return f"pip install {editable}'{folder}[{extra}]'"


def list_requirements(extra: str = "") -> list[Requirement]:
    """List the requirements of the package, or those that an extra adds."""
    lines = importlib.metadata.requires("gscompleter") or []
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
