"""The JavaScript renderer of the viewer: npm packages pinned by their hashes.

`package-lock.json` pins three.js, Spark (which renders Gaussians with it) and fflate (part of
Spark). A wheel contains them; a source tree fetches and caches them when a page is first made.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import tarfile
import urllib.request
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

from gscompleter.system.errors import InputError
from gscompleter.system.files.downloads import get_download_folder
from gscompleter.system.files.writing import replace_file

LOCK_FILE = Path(__file__).with_name("package-lock.json")
BUILT_LIBRARIES = Path(__file__).with_name("libraries.json")
"""Libraries stored by the build of a wheel."""
MODULES = {
    "three": ("three", "build/three.module.min.js"),
    "three-core": ("three", "build/three.core.min.js"),
    "three/addons/postprocessing/Pass.js": ("three", "examples/jsm/postprocessing/Pass.js"),
    "three/addons/controls/TransformControls.js": (
        "three",
        "examples/jsm/controls/TransformControls.js",
    ),
    "@sparkjsdev/spark": ("@sparkjsdev/spark", "dist/spark.module.min.js"),
}
"""Package and file of each module, by its import name."""
CORE_IMPORT = ('"./three.core.min.js"', '"three-core"')
"""Replacement for the one relative import: modules in a page have no folder."""
REGISTRY = "https://registry.npmjs.org"
TIMEOUT_SECONDS = 30.0


@dataclass(frozen=True)
class NpmPackage:
    """One npm package, as pinned by the lock."""

    name: str
    version: str
    integrity: str
    """`sha512-` and the hash in base64, as npm and browsers write it."""

    @property
    def path(self) -> str:
        """Path of its archive in every npm registry."""
        return f"{self.name}/-/{self.name.rsplit('/', 1)[-1]}-{self.version}.tgz"

    def is_intact(self, archive: bytes) -> bool:
        """Return True if `archive` has the pinned hash."""
        digest = base64.b64encode(hashlib.sha512(archive).digest()).decode()
        return self.integrity == f"sha512-{digest}"


@dataclass(frozen=True)
class Libraries:
    """JavaScript for a page."""

    modules: Mapping[str, str]
    """ES modules by import name."""
    licences: Mapping[str, str]
    """Licence texts by package name and version."""


def load_libraries() -> Libraries:
    """Load the libraries of the wheel, or in a source tree those of the pinned archives."""
    if BUILT_LIBRARIES.is_file():
        return Libraries(**json.loads(BUILT_LIBRARIES.read_text(encoding="utf-8")))
    return extract_libraries(LOCK_FILE)


def extract_libraries(lock: Path) -> Libraries:
    """Extract the modules and licences of the packages pinned in `lock`."""
    packages = read_lock(lock)
    files = {
        package.name: read_archive(
            get_archive(package),
            {"LICENSE", *(f for p, f in MODULES.values() if p == package.name)},
        )
        for package in packages
    }
    modules = {
        name: files[package][file].replace(*CORE_IMPORT)
        for name, (package, file) in MODULES.items()
    }
    licences = {
        f"{package.name} {package.version}": files[package.name]["LICENSE"] for package in packages
    }
    return Libraries(modules, licences)


def read_lock(lock: Path) -> list[NpmPackage]:
    """Read the packages of an npm lock file (`lockfileVersion` 3), in order."""
    entries = json.loads(lock.read_text(encoding="utf-8"))["packages"]
    return [
        NpmPackage(path.removeprefix("node_modules/"), entry["version"], entry["integrity"])
        for path, entry in entries.items()
        # The root of the project has an empty path.
        if path
    ]


def get_archive(package: NpmPackage) -> bytes:
    """Get the archive of a package from the cache, or fetch and cache it (`fetch_archive`)."""
    place = get_archive_path(package)
    # What was cached is checked as well: it may be damaged, or put there by hand.
    if place.is_file():
        cached = place.read_bytes()
        if package.is_intact(cached):
            return cached
    archive = fetch_archive(package)
    place.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(place) as file:
        file.write(archive)
    return archive


def get_archive_path(package: NpmPackage) -> Path:
    """Get the path of an archive in the cache; users may put it there by hand."""
    return get_download_folder() / "viewer" / Path(package.path).name


def fetch_archive(package: NpmPackage) -> bytes:
    """Fetch an archive from the npm registry and compare its hash.

    Raises InputError without a connection, and if the hash differs.
    """
    url = f"{REGISTRY}/{package.path}"
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_SECONDS) as answer:
            archive: bytes = answer.read()
        if package.is_intact(archive):
            return archive
        reason = "its SHA-512 differs"
    except (OSError, HTTPException) as error:
        # A connection that ends midway raises an HTTPException, which is no OSError.
        reason = f"it cannot be fetched ({error})"
    raise InputError(
        f"The page needs {url}, but {reason}; install gscompleter from its wheel, which contains "
        f"it, or put it at {get_archive_path(package)}."
    )


def read_archive(archive: bytes, names: Collection[str]) -> dict[str, str]:
    """Read text files of an npm archive, below its folder `package`."""
    found = {}
    # The archive is never unpacked to disk, and decompressed once for all of them, up to the last.
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r|gz") as files:
        for member in files:
            name = member.name.removeprefix("package/")
            content = files.extractfile(member) if name in names else None
            if content is not None:
                found[name] = content.read().decode()
            if len(found) == len(names):
                break
    return found
