"""The command `doctor`: the state of the installation and what is missing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from gscompleter.config.settings import Settings
from gscompleter.errors import InputError

if TYPE_CHECKING:  # every command reads this file, and only this one needs it
    from packaging.requirements import Requirement

DISTRIBUTION = "gscompleter"

PURPOSES = {
    "cuda": "rendering on an NVIDIA GPU",
    "evaluation": "the plots of evaluate, tables and bench",
    "models": "downloading published weights from the Hugging Face hub",
    "diffusion": "--generator pe-field and diffusers-inpaint",
    "poses": "photographs whose cameras are not known",
    "fid": "tables --fid",
    "live": "completing in the browser with gscompleter live",
    "browser": "the picture of the viewer (examples/04_picture_of_the_viewer.py)",
    "film": "complete --video",
    "ray": "batch --engine ray",
    "slurm": "batch --engine submitit",
    "waymo": "the Waymo Open Dataset 2, whose tables are parquet",
}
"""Purpose of each extra. Those for developers (`test`, `dev`, `docs`) are not listed."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(Settings):
    """Print what is installed (device, renderers, packages, extras, weights, caches).

    For everything that is missing it prints the purpose and what to do. Nothing is downloaded or
    changed. The default models need the packages only.
    """

    json: bool = False
    """Print the result as JSON."""


@dataclass(frozen=True)
class Found:
    """One line of the result."""

    kind: str
    name: str
    there: bool
    told: str
    """Versions and locations, or the purpose of a missing part and what to do."""


def run_doctor(options: DoctorOptions) -> None:
    """Inspect the installation and print the result."""
    found = list(inspect_installation())
    if options.json:
        print(json.dumps([asdict(one) for one in found], indent=2))
    else:
        print_findings(found)


def print_findings(found: list[Found]) -> None:
    """Print the result, grouped by kind."""
    width = max(len(one.name) for one in found)
    kinds = dict.fromkeys(one.kind for one in found)
    for kind in kinds:
        print(f"{kind}:")
        for one in found:
            if one.kind == kind:
                print(f"  {one.name:{width}}  {'' if one.there else 'missing: '}{one.told}")


def inspect_installation() -> Iterator[Found]:
    """Inspect all parts, in the order of the result."""
    yield from inspect_machine()
    yield from inspect_packages()
    yield from inspect_extras()
    yield from inspect_renderers()
    yield from inspect_weights()
    yield from inspect_viewer()
    yield from inspect_caches()


def inspect_machine() -> Iterator[Found]:
    """Inspect versions, processor, memory and device."""
    # Imported here so that `--help` does not wait for torch.
    from gscompleter.apps.bench.machine import describe_machine
    from gscompleter.render import choose_device

    facts = describe_machine(choose_device())
    unit = {"memory_gb": ("memory", " GB")}
    for name, value in facts.items():
        shown, suffix = unit.get(name, (name, ""))
        yield Found("machine", shown, True, f"{value}{suffix}")


def inspect_packages() -> Iterator[Found]:
    """Inspect the packages that everything needs."""
    for requirement in list_requirements():
        there = find_installed_version(requirement)
        details = there or f"{requirement}, which every command needs; pip install '{requirement}'"
        yield Found("packages", requirement.name, there is not None, details)


def inspect_extras() -> Iterator[Found]:
    """Inspect the extras."""
    for extra, purpose in PURPOSES.items():
        if not list_requirements(extra):
            why = f"the installed version or this Python is older than this extra; for {purpose}"
            yield Found("extras", extra, False, why)
            continue
        versions = {
            requirement.name: find_installed_version(requirement)
            for requirement in list_requirements(extra)
        }
        missing = [name for name, there in versions.items() if there is None]
        listed = ", ".join(missing or [f"{name} {there}" for name, there in versions.items()])
        remedy = f"; pip install '{DISTRIBUTION}[{extra}]'" if missing else ""
        yield Found("extras", extra, not missing, f"{listed}, for {purpose}{remedy}")


def list_requirements(extra: str = "") -> list[Requirement]:
    """List the requirements of the package, or those that an extra adds."""
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    try:
        all_of_them = [Requirement(line) for line in requires(DISTRIBUTION) or []]
    except PackageNotFoundError:
        raise InputError(
            f"{DISTRIBUTION} is not installed, so its requirements are unknown; run "
            "`pip install .` in its source folder."
        ) from None
    return [r for r in all_of_them if is_required_by(extra, r)]


def is_required_by(extra: str, requirement: Requirement) -> bool:
    """Return True if an extra adds this requirement; without a name, if all need it."""
    if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
        return not extra
    return bool(extra) and requirement.marker.evaluate({"extra": extra})


def find_installed_version(requirement: Requirement) -> str | None:
    """Return the installed version if it satisfies the requirement."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        there = version(requirement.name)
    except PackageNotFoundError:
        return None
    return there if requirement.specifier.contains(there, prereleases=True) else None


def inspect_renderers() -> Iterator[Found]:
    """Inspect the renderers and the compiled kernels."""
    from gscompleter.apps.warmup.compilation import PARTS
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.render import load_renderer

    for name in ("cpu", "cuda", "reference"):
        try:
            load_renderer(name)
        except InputError as error:
            yield Found("renderers", name, False, str(error))
        else:
            yield Found("renderers", name, True, "draws here")
    missing = [part for part in PARTS if not is_compiled(part)]
    lacking = "compiled by the first completion, or in advance by `gscompleter warmup`"
    yield Found("renderers", "kernels", not missing, lacking if missing else "compiled")


def inspect_weights() -> Iterator[Found]:
    """Inspect the published weights of reconstructors and LPIPS."""
    from gscompleter.evaluation.metrics.lpips import NETWORKS
    from gscompleter.evaluation.metrics.lpips import get_weights_path as place_of_lpips
    from gscompleter.models.weights.fetching import find_cached
    from gscompleter.models.weights.published import PUBLISHED

    here = [name for name, published in PUBLISHED.items() if find_cached(published)]
    listed = ", ".join(here) or f"all {len(PUBLISHED)} that `gscompleter models` lists"
    yield Found("weights", "reconstructors", bool(here), f"{listed}, for --reconstructor")
    for name, network in NETWORKS.items():
        places = [place_of_lpips(file, None) for file in (network.backbone, network.linear)]
        there = all(place.is_file() for place in places)
        details = "for LPIPS in the tables of evaluate" + (
            "" if there else "; load_lpips fetches it"
        )
        yield Found("weights", f"lpips-{name}", there, details)


def inspect_viewer() -> Iterator[Found]:
    """Inspect the JavaScript libraries of the pages."""
    from gscompleter.apps.viewer.packages import (
        BUILT_LIBRARIES,
        LOCK_FILE,
        get_archive_path,
        read_lock,
    )

    if BUILT_LIBRARIES.is_file():
        yield Found("viewer", "libraries", True, f"with the package, {BUILT_LIBRARIES}")
        return
    missing = [p for p in read_lock(LOCK_FILE) if not get_archive_path(p).is_file()]
    names = ", ".join(package.name for package in missing)
    lacking = f"{names}, fetched with npm's registry when `gscompleter view` is first run"
    yield Found("viewer", "libraries", not missing, lacking if missing else "in the cache")


def inspect_caches() -> Iterator[Found]:
    """Inspect the cache folders."""
    import torch

    from gscompleter.io.cache import get_download_folder
    from gscompleter.kernels.compiled import get_cache_folder as kernels_folder

    yield Found("caches", "downloads", True, f"{get_download_folder()} (GSCOMPLETER_HOME)")
    yield Found("caches", "kernels", True, f"{kernels_folder()} (NUMBA_CACHE_DIR)")
    yield Found("caches", "torch.hub", True, f"{torch.hub.get_dir()} (TORCH_HOME)")
