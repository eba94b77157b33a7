"""The JavaScript that draws Gaussians: npm packages pinned by their hashes, fetched once.

`package-lock.json` is npm's own: version and SHA-512 of three.js, of Spark, which draws
Gaussians with it, and of fflate, which lies within Spark. A wheel brings what `libraries_from`
takes out of them; a source tree fetches the three archives when a page is first made, from the
registry that npm is set to, and keeps them in our cache. An archive is compared with its hash
whenever it is opened, so that it does not matter which registry it came from.

Nothing here needs more than Python itself, for the build of the wheel runs it.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import shutil
import subprocess
import tarfile
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from gscompleter.cache import cache_folder
from gscompleter.errors import InputError
from gscompleter.io.files import replacing

LOCK = Path(__file__).with_name("package-lock.json")
"""Which packages, from where, with which hashes."""
BUILT = Path(__file__).with_name("libraries.json")
"""What the build of a wheel leaves: the libraries, ready to be put into a page."""
MODULES = {
    "three": ("three", "build/three.module.min.js"),
    "three-core": ("three", "build/three.core.min.js"),
    "three/addons/postprocessing/Pass.js": ("three", "examples/jsm/postprocessing/Pass.js"),
    "@sparkjsdev/spark": ("@sparkjsdev/spark", "dist/spark.module.min.js"),
}
"""By the name that they are imported by: the package of each module, and its file there."""
CORE = ('"./three.core.min.js"', '"three-core"')
"""A module in a page has no folder, so that the one relative import among them gets a name."""
LICENCE = "LICENSE"
"""The file of each package that has to go with it."""
LARGEST_ARCHIVE = 64 << 20
"""Bytes of an archive; the largest of ours has 8 million."""
SECONDS_TO_ANSWER = 30.0
"""How long a silent registry is waited for."""
REGISTRY = "npm_config_registry"
"""The environment variable of npm that says where packages come from; npm knows it otherwise."""


@dataclass(frozen=True)
class Package:
    """One npm package, as the lock pins it."""

    name: str
    version: str
    integrity: str
    """`sha512-` and the hash in base64, as npm and browsers write it."""

    @property
    def file(self) -> str:
        """What its archive is called in our cache."""
        return f"{self.name.replace('/', '-').lstrip('@')}-{self.version}.tgz"

    @property
    def path(self) -> str:
        """Where every npm registry has its archive."""
        return f"{self.name}/-/{self.name.rsplit('/', 1)[-1]}-{self.version}.tgz"

    def is_intact(self, archive: bytes) -> bool:
        """Whether these bytes are the archive that was pinned."""
        digest = base64.b64encode(hashlib.sha512(archive).digest()).decode()
        return self.integrity == f"sha512-{digest}"


@dataclass(frozen=True)
class Libraries:
    """JavaScript to put into a page."""

    modules: Mapping[str, str]
    """ES modules by the name that they are imported by."""
    licences: Mapping[str, str]
    """The licence of each package, by its name and version."""


def load_libraries(lock: Path = LOCK, built: Path = BUILT) -> Libraries:
    """The libraries as the wheel brought them; in a source tree from the pinned archives.

    Args:
        lock: An npm lock file.
        built: Where a wheel has the libraries.

    Raises:
        InputError: where they are in neither place and cannot be fetched, or are not what was
            pinned.
    """
    if built.is_file():
        return Libraries(**json.loads(built.read_text(encoding="utf-8")))
    return libraries_from(lock)


def write_libraries(path: Path, lock: Path = LOCK) -> None:
    """Write the libraries to `path`, for a wheel: the same lock gives the same bytes.

    Raises:
        InputError: as `load_libraries`, and where the file cannot be written.
    """
    text = json.dumps(vars(libraries_from(lock)), sort_keys=True, ensure_ascii=False)
    with replacing(path) as file:
        file.write(text.encode())


def libraries_from(lock: Path) -> Libraries:
    """What a page needs of the packages that are pinned in `lock`.

    Raises:
        InputError: where an archive cannot be fetched, or is not what was pinned.
    """
    packages = {package.name: package for package in read_lock(lock)}
    archives = {name: archive_of(package) for name, package in packages.items()}
    modules = {
        name: member(archives[package], file).replace(*CORE)
        for name, (package, file) in MODULES.items()
    }
    licences = {
        f"{p.name} {p.version}": member(archives[name], LICENCE) for name, p in packages.items()
    }
    return Libraries(modules, licences)


def read_lock(lock: Path) -> list[Package]:
    """The packages of an npm lock file (`lockfileVersion` 3), in its order."""
    entries = json.loads(lock.read_text(encoding="utf-8"))["packages"]
    return [
        Package(path.removeprefix("node_modules/"), e["version"], e["integrity"])
        for path, e in entries.items()
        if path
    ]


def archive_of(package: Package) -> bytes:
    """The archive of a package: from our cache, or else fetched and kept there.

    Raises:
        InputError: where it cannot be fetched, or what comes is not what was pinned.
    """
    place = place_of(package)
    if place.is_file():
        archive = place.read_bytes()
        if package.is_intact(archive):
            return archive
    archive = fetched(package)
    place.parent.mkdir(parents=True, exist_ok=True)
    with replacing(place) as file:
        file.write(archive)
    return archive


def place_of(package: Package) -> Path:
    """Where its archive is kept, and where one that was fetched by hand is looked for."""
    return cache_folder() / "viewer" / package.file


def fetched(package: Package) -> bytes:
    """The archive of a package from the npm registry.

    Raises:
        InputError: where it cannot be fetched, or what comes is not what was pinned.
    """
    url = f"{registry_for(package)}/{package.path}"
    try:
        with urllib.request.urlopen(url, timeout=SECONDS_TO_ANSWER) as answer:
            archive: bytes = answer.read(LARGEST_ARCHIVE)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{needed(package)}, and {urlsplit(url).netloc or 'its place'} cannot be reached; "
            f"fetch {url} and put it at {place_of(package)}."
        ) from error
    if not package.is_intact(archive):
        raise InputError(
            f"What lies at {url} is not {package.name} {package.version} as it was pinned: "
            "its SHA-512 differs, and it was not used; try another connection."
        )
    return archive


def registry_for(package: Package) -> str:
    """Where npm gets packages from: what its environment variable says, or else npm itself.

    Raises:
        InputError: where neither is there.
    """
    address, npm = os.environ.get(REGISTRY), shutil.which("npm")
    if not address and npm is not None:
        asked = [npm, "config", "get", "registry"]
        answer = subprocess.run(asked, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        address = answer.stdout.strip()
    if not address:
        raise InputError(
            f"{needed(package)}, and without npm nothing tells where to fetch it; install "
            f"gscompleter from its wheel, which brings it, or name npm's registry in the "
            f"environment variable {REGISTRY}."
        )
    return address.rstrip("/")


def needed(package: Package) -> str:
    """The beginning of a sentence about a package that is missing."""
    return f"The page needs {package.name} {package.version}, which is not on this machine"


def member(archive: bytes, name: str) -> str:
    """The text of one file of an npm archive, in which all lie in the folder `package`."""
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as files:
        file = files.extractfile(f"package/{name}")
        assert file is not None
        return file.read().decode()
