"""Wheel and sdist, installed in another folder, and the documentation of extras."""

from __future__ import annotations

import json
import re
import shutil
import site
import sys
import tarfile
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement

import gscompleter
from command import run
from gscompleter import __version__
from gscompleter.apps.installation import PURPOSES, find_installed_version, is_required_by
from gscompleter.apps.warmup import PARTS, compile_kernels
from gscompleter.numerics.kernels.compiled import get_cache_folder
from release_check import (
    ROOT,
    built,
    check_answers,
    check_completion,
    environment,
    install,
)

DEVELOPERS = {"test-core", "test", "dev", "docs"}
KERNELS = Path("numerics", "kernels")
"""Extras that users do not need."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return built("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory) -> Path:
    return built("sdist", tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def unpacked(sdist, tmp_path_factory) -> Path:
    """Return the sources of the sdist, with other times and permissions."""
    folder = tmp_path_factory.mktemp("sources")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (sources,) = folder.iterdir()
    for path in sources.rglob("*.py"):
        path.chmod(0o600)
    return sources


def extras() -> set[str]:
    """Read the extras of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text()
    table = text.split("[project.optional-dependencies]")[1].split("\n[")[0]
    return set(re.findall(r"^([\w-]+) = ", table, re.M))


def test_the_wheel_holds_the_package_the_viewer_and_the_licences(wheel):
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
        libraries = json.loads(archive.read("gscompleter/apps/viewer/libraries.json"))
    sources = ROOT / "src"
    ours = {p.relative_to(sources).as_posix() for p in sources.rglob("*") if p.is_file()}
    ours = {name for name in ours if "__pycache__" not in name and ".egg-info" not in name}
    info = f"gscompleter-{__version__}.dist-info"
    assert ours <= names
    assert f"{info}/licenses/LICENSE" in names
    assert {name.split("/")[0] for name in names} == {"gscompleter", info}
    assert [name.rsplit(" ", 1)[0] for name in libraries["licences"]]
    assert all("permission" in text.lower() for text in libraries["licences"].values())


def test_the_same_sources_give_the_same_bytes_wherever_they_lie(
    wheel, sdist, unpacked, tmp_path, monkeypatch
):
    """An sdist contains the viewer's libraries, and so needs no connection."""
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path / "nothing"))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    assert built("wheel", tmp_path / "wheel", unpacked).read_bytes() == wheel.read_bytes()
    assert built("sdist", tmp_path / "sdist", unpacked).read_bytes() == sdist.read_bytes()


def test_the_wheel_runs_by_itself_in_another_folder(wheel, room, tmp_path):
    """The environment has the wheel, and borrows its requirements from ours."""
    programs = environment(sys.executable, tmp_path / "environment")
    install(programs, "--no-deps", str(wheel))
    (packages,) = (tmp_path / "environment").glob("lib/*/site-packages")
    (packages / "ours.pth").write_text("\n".join(site.getsitepackages()))
    borrow_kernels(packages / "gscompleter")
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    check_answers(programs, folder)
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20, "--resolution", 32)
    check_completion(programs, folder, room, *frames)
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["version"] == __version__


def borrow_kernels(package: Path) -> None:
    """Copy our compiled kernels, which are valid for the same sources and times."""
    compile_kernels(list(PARTS))
    ours = Path(gscompleter.__file__).parent
    for source in (ours / KERNELS).glob("*.py"):
        shutil.copystat(source, package / KERNELS / source.name)
    place, unfinished = package / KERNELS / "__pycache__", shutil.ignore_patterns("*.tmp.*")
    shutil.copytree(get_cache_folder(), place, ignore=unfinished, dirs_exist_ok=True)


def test_doctor_says_what_every_extra_is_for():
    assert set(PURPOSES) | DEVELOPERS == extras()


def test_the_page_on_installing_has_every_extra():
    rows = re.findall(r"^\| `([\w-]+)` \|", (ROOT / "docs" / "install.md").read_text(), re.M)
    assert set(rows) == set(PURPOSES)


def test_container_files_name_extras_that_there_are():
    files = sorted((ROOT / "docker").glob("*.Dockerfile"))
    named = [set(re.findall(r"gscompleter\[([\w,]+)\]", path.read_text())) for path in files]
    assert len(files) == 2
    assert all(set(",".join(found).split(",")) <= set(PURPOSES) for found in named)


def test_the_version_is_the_same_wherever_it_stands():
    citation, changes = (ROOT / name for name in ("CITATION.cff", "CHANGELOG.md"))
    assert re.search(r"^version: (.+)$", citation.read_text(), re.M)[1] == __version__
    assert re.search(r"^## ([\d.]+)", changes.read_text(), re.M)[1] == __version__


def test_doctor_tells_of_what_is_missing_and_for_what(monkeypatch, capsys):
    monkeypatch.setattr(
        "importlib.metadata.requires",
        lambda _: ["numpy>=1", "numpy>=99; extra == 'film'", "not-there; extra == 'poses'"],
    )
    assert run(monkeypatch, "doctor", "--json") == 0
    found = {(one["kind"], one["name"]): one for one in json.loads(capsys.readouterr().out)}
    assert found["packages", "numpy"]["there"]
    assert not found["extras", "film"]["there"]
    assert "--video" in found["extras", "film"]["told"]
    assert "pip install 'gscompleter[poses]'" in found["extras", "poses"]["told"]
    assert not found["extras", "ray"]["there"]
    assert "older than this extra" in found["extras", "ray"]["told"]
    assert run(monkeypatch, "doctor") == 0
    assert "missing: not-there, for photographs whose" in capsys.readouterr().out


def test_a_version_that_is_too_old_will_not_do():
    assert find_installed_version(Requirement("numpy>=1.0")) is not None
    assert find_installed_version(Requirement("numpy>=99")) is None
    assert find_installed_version(Requirement("a-package-that-is-not-there")) is None


def test_an_extra_is_what_it_adds():
    always, added = Requirement("numpy"), Requirement("gsplat; extra == 'cuda'")
    assert [is_required_by("", r) for r in (always, added)] == [True, False]
    assert [is_required_by("cuda", r) for r in (always, added)] == [False, True]
    assert not is_required_by("film", added)
