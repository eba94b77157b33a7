"""Wheel and sdist, installed in another folder, and the documentation of extras."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import site
import subprocess
import sys
import tarfile
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from packaging.requirements import Requirement

import gscompleter
import link_readme
from command import run
from gscompleter import __version__
from gscompleter.apps import installation
from gscompleter.apps.installation import (
    PURPOSES,
    WEIGHT_USES,
    describe_build,
    find_installed_version,
    inspect_extra,
    inspect_kernels,
    inspect_weights,
    is_required_by,
    make_install_command,
)
from gscompleter.apps.warmup import PARTS, compile_kernels
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.numerics.kernels.cache import KernelCache
from gscompleter.numerics.kernels.compiled import get_cache_folder
from gscompleter.render.gsplat_kernels import explain_missing_gpu
from release_check import (
    IMPORT_EXTRA,
    ROOT,
    built,
    check_answers,
    check_completion,
    check_demo,
    environment,
    install,
    ran,
)

DEVELOPERS = {"test-core", "test", "dev", "docs"}
"""Extras that users do not need."""
KERNELS = Path("numerics", "kernels")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    pytest.importorskip("hatchling", reason="needs gscompleter[test]")
    return built("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory) -> Path:
    pytest.importorskip("hatchling", reason="needs gscompleter[test]")
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


# `make dist` builds the package.
@pytest.mark.slow
def test_the_same_sources_give_the_same_bytes_wherever_they_lie(
    wheel, unpacked, tmp_path, monkeypatch
):
    """An sdist contains the viewer's libraries, and so needs no connection."""
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path / "nothing"))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    assert built("wheel", tmp_path / "wheel", unpacked).read_bytes() == wheel.read_bytes()


# The wheel of the unpacked sdist, above, is the same.
@pytest.mark.slow
def test_the_same_sources_give_the_same_sdist(sdist, unpacked, tmp_path):
    assert built("sdist", tmp_path / "sdist", unpacked).read_bytes() == sdist.read_bytes()


def test_the_unpacked_wheel_answers(wheel, tmp_path):
    with ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    said = "import gscompleter, gscompleter.cli as c; print(gscompleter.__file__); c.main()"
    done = subprocess.run(
        [sys.executable, "-c", said, "--version"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    file, version = done.stdout.splitlines()
    assert Path(file).parent == tmp_path / "gscompleter"
    assert version == __version__


# `test_the_unpacked_wheel_answers` needs no environment of its own.
@pytest.mark.slow
@pytest.mark.linux
def test_the_wheel_runs_by_itself_in_another_folder(wheel, tmp_path):
    """The environment has the wheel, and borrows its requirements from ours."""
    programs = environment(sys.executable, tmp_path / "environment")
    install(programs, "--no-deps", str(wheel))
    (packages,) = (tmp_path / "environment").glob("lib/*/site-packages")
    (packages / "ours.pth").write_text("\n".join(site.getsitepackages()))
    borrow_kernels(packages / "gscompleter")
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    check_answers(programs, folder)
    found = ran(programs, folder, "python", "-c", "import gscompleter as g; print(g.__file__)")
    assert Path(found.strip()).parent == packages / "gscompleter"
    summary = json.loads((check_completion(programs, folder) / "summary.json").read_text())
    assert summary["version"] == __version__


@pytest.mark.linux
@pytest.mark.slow
@pytest.mark.parametrize("extra", ["", *sorted(PURPOSES)])
def test_the_wheel_installs_into_an_empty_environment(wheel, extra, tmp_path):
    """With what pip finds for it: the demo for the core, an import for each extra."""
    programs = environment(sys.executable, tmp_path / "environment")
    try:
        install(programs, f"gscompleter{f'[{extra}]' if extra else ''} @ {wheel.as_uri()}")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"pip does not find the packages: {error}")
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    if extra:
        assert ran(programs, folder, "python", "-c", IMPORT_EXTRA, extra).strip()
    else:
        check_answers(programs, folder)
        check_demo(programs, folder)


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
    poses = found["extras", "poses"]
    assert poses["told"] == "not-there, for photographs whose cameras are not known"
    assert re.fullmatch(r"pip install .*\[poses\].*", poses["install"])
    assert found["packages", "numpy"]["install"] is None
    assert not found["extras", "ray"]["there"]
    assert "older than this extra" in found["extras", "ray"]["told"]
    assert run(monkeypatch, "doctor") == 0
    shown = capsys.readouterr().out
    assert "missing: not-there, for photographs whose" in shown
    assert poses["install"] in shown


@pytest.mark.parametrize(
    ("source", "command"),
    [
        (None, "pip install 'gscompleter[film]'"),
        (
            {"url": "https://example.org/a.whl", "archive_info": {}},
            "pip install 'gscompleter[film] @ https://example.org/a.whl'",
        ),
        (
            {"url": "https://example.org/a.git", "vcs_info": {"vcs": "git", "commit_id": "0a1b"}},
            "pip install 'gscompleter[film] @ git+https://example.org/a.git@0a1b'",
        ),
        (
            {
                "url": "file:///d/all",
                "vcs_info": {"vcs": "git", "commit_id": "0a1b"},
                "subdirectory": "code",
            },
            "pip install 'gscompleter[film] @ git+file:///d/all@0a1b#subdirectory=code'",
        ),
        (
            {"url": "file:///d/gscompleter-0.1.0.whl", "archive_info": {}},
            "pip install 'gscompleter[film] @ file:///d/gscompleter-0.1.0.whl'",
        ),
        ({"url": "file:///my%20code", "dir_info": {}}, f"pip install '{Path('/my code')}[film]'"),
        (
            {"url": "file:///code", "dir_info": {"editable": True}},
            f"pip install -e '{Path('/code')}[film]'",
        ),
    ],
)
def test_the_command_for_an_extra_is_that_of_this_installation(monkeypatch, source, command):
    class Installed:
        def read_text(self, name: str) -> str | None:
            return None if source is None else json.dumps(source)

    monkeypatch.setattr("importlib.metadata.distribution", lambda _: Installed())
    assert make_install_command("film") == command


def test_the_command_for_an_extra_may_be_given_to_a_shell(monkeypatch):
    class Installed:
        def read_text(self, name: str) -> str:
            return json.dumps({"url": "file:///Ann's%20code", "dir_info": {}})

    monkeypatch.setattr("importlib.metadata.distribution", lambda _: Installed())
    words = shlex.split(make_install_command("film"))
    assert words == ["pip", "install", str(Path("/Ann's code")) + "[film]"]


def test_doctor_ends_with_an_error_where_a_needed_extra_is_missing(monkeypatch, capsys):
    lines = ["numpy>=1; extra == 'film'", "not-there; extra == 'poses'"]
    monkeypatch.setattr("importlib.metadata.requires", lambda _: lines)
    assert run(monkeypatch, "doctor", "--needs", "film") == 0
    assert run(monkeypatch, "doctor", "--needs", "film", "poses") == 1
    capsys.readouterr()
    assert run(monkeypatch, "doctor", "--needs", "poses", "--json") == 1
    assert json.loads(capsys.readouterr().out)
    assert run(monkeypatch, "doctor", "--needs", "everything") == 2
    assert "There is no extra 'everything'" in capsys.readouterr().err


def test_an_extra_needs_what_the_extras_of_its_packages_bring(monkeypatch):
    lines = {
        "gscompleter": ["numpy>=1", "scipy[plots]>=1; extra == 'film'"],
        "scipy": ["pytest", "not-there; extra == 'plots'", "scipy[plots]; extra == 'plots'"],
    }
    monkeypatch.setattr("importlib.metadata.requires", lines.get)
    found = inspect_extra("film", "videos")
    assert (found.there, found.told) == (False, "not-there, for videos")
    lines["scipy"] = ["not-there; extra == 'others'"]
    assert inspect_extra("film", "videos").there


def test_doctor_answers_where_the_package_is_not_installed(monkeypatch, capsys):
    def refuse(name: str):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", refuse)
    monkeypatch.setattr("importlib.metadata.distribution", refuse)
    assert run(monkeypatch, "doctor") == 0
    shown = capsys.readouterr().out
    assert "missing: it runs from a folder and is not installed" in shown
    assert "its packages are not known; for videos" in shown
    assert "older than this extra" not in shown


def test_without_a_folder_for_kernels_no_warmup_is_advised(monkeypatch):
    monkeypatch.setattr(installation, "CACHE", KernelCache(None, "no folder"))
    found = inspect_kernels()
    assert (found.there, found.told, found.install) == (False, "compiled again in each run", None)


def test_weights_are_told_by_the_option_that_takes_them(monkeypatch):
    monkeypatch.setattr(installation, "find_cached", lambda weights: weights.name == "lama")
    taken = {
        option: list(filter(takes, PUBLISHED.values())) for option, takes in WEIGHT_USES.items()
    }
    found = {option: inspect_weights(option, published) for option, published in taken.items()}
    assert found["generator"].told == "lama, for --generator"
    assert found["generator"].install is None
    assert not found["reconstructor"].there
    assert not found["depth"].there
    assert "moge-2" in [weights.name for weights in taken["depth"]]


def test_torch_for_cuda_without_a_gpu_is_told(monkeypatch):
    monkeypatch.setattr("torch.version.cuda", "13.0")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    told = describe_build(Requirement("torch"), "2.13.0")
    assert "gigabytes smaller" in told
    # There may be one, which torch does not see.
    assert "or its driver is older than CUDA 13.0" in told
    assert describe_build(Requirement("numpy"), "2.0") == "2.0"


def test_torch_for_rocm_without_a_gpu_names_no_cuda(monkeypatch):
    monkeypatch.setattr("torch.version.cuda", None)
    monkeypatch.setattr("torch.version.hip", "6.4")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    told = explain_missing_gpu()
    assert told is not None
    assert told.endswith("or its driver is older than ROCm 6.4")


def test_a_version_that_is_too_old_will_not_do():
    assert find_installed_version(Requirement("numpy>=1.0")) is not None
    assert find_installed_version(Requirement("numpy>=99")) is None
    assert find_installed_version(Requirement("a-package-that-is-not-there")) is None


def test_an_extra_is_what_it_adds():
    always, added = Requirement("numpy"), Requirement("gsplat; extra == 'cuda'")
    assert [is_required_by("", r) for r in (always, added)] == [True, False]
    assert [is_required_by("cuda", r) for r in (always, added)] == [False, True]
    assert not is_required_by("film", added)


# ------------------------------------------------------------------- the workflow of a release


def read_workflow() -> dict:
    return yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text("utf-8"))


def test_only_the_upload_of_a_tag_may_prove_who_it_is():
    """Trusted publishing: a token of the run in place of a stored password."""
    workflow = read_workflow()
    assert workflow[True] == {"push": {"tags": ["v*"]}}  # YAML takes the word `on` for true
    assert workflow["permissions"] == {"contents": "read"}
    jobs = workflow["jobs"]
    allowed = {name for name, job in jobs.items() if "id-token" in job.get("permissions", {})}
    assert allowed == {"publish"}
    assert jobs["publish"]["environment"]["name"] == "pypi"
    assert set(jobs["publish"]["needs"]) == {"build", "try"}
    assert "secrets." not in str(workflow)


def test_every_extra_is_tried_before_the_upload():
    extras = read_workflow()["jobs"]["try"]["strategy"]["matrix"]["extra"]
    assert {*extras, "metal"} == {"", *PURPOSES}


def test_the_page_on_pypi_links_to_the_repository(tmp_path, monkeypatch):
    text = (
        "[![a](https://b.org/c)](LICENSE) ![d](docs/e.jpg) [f](docs/g.md#h) [i](#j) [k](http://l)"
    )
    linked = link_readme.make_absolute(text, "me/it", "v1")
    place = "https://github.com/me/it"
    assert linked == (
        f"[![a](https://b.org/c)]({place}/blob/v1/LICENSE) ![d]({place}/raw/v1/docs/e.jpg) "
        f"[f]({place}/blob/v1/docs/g.md#h) [i](#j) [k](http://l)"
    )
    readme = (ROOT / "README.md").read_text("utf-8")
    left = link_readme.make_absolute(readme, "me/it", "v1")
    assert not link_readme.LINK.search(left)
    named = re.findall(rf"{place}/(?:raw|blob)/v1/([^)#]+)", left)
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_a_tag_has_to_be_that_of_the_version():
    source = (ROOT / "src" / "gscompleter" / "__init__.py").read_text("utf-8")
    link_readme.check_tag(f"v{__version__}", source)
    for tag in (__version__, "v99"):
        with pytest.raises(SystemExit, match="tag that one"):
            link_readme.check_tag(tag, source)


# ------------------------------------------------------------------- what pages say of installing


def list_install_lines() -> list[tuple[str, str]]:
    """List the lines of pages, workflows, images, the Makefile and the program, with files."""
    named = ["README.md", "llms.txt", "Makefile", *("docs/install.md", "docs/index.md")]
    files = [ROOT / name for name in named]
    files += [*(ROOT / "docker").glob("*.Dockerfile"), *(ROOT / ".github").rglob("*.yml")]
    files += [*(ROOT / "src").rglob("*.py")]
    return [(path.name, line) for path in files for line in path.read_text("utf-8").splitlines()]


def test_the_cpu_build_of_torch_comes_from_its_index_alone():
    """With a further index pip takes the build for CUDA in silence where that one fails."""
    lines = list_install_lines()
    assert [
        (name, line)
        for name, line in lines
        if "--extra-index-url" in line and ("pip install" in line or ":=" in line)
    ] == []
    from_cpu = {
        name for name, line in lines if re.search(r"--index-url \S*(whl/cpu|CPU_INDEX)", line)
    }
    assert {"README.md", "install.md", "llms.txt", "Makefile", "cpu.Dockerfile"} <= from_cpu


def test_the_first_install_line_serves_the_first_command_and_names_the_wheel():
    """README's first use is photographs or a video, and the name is on no index yet."""
    for page in ("README.md", "docs/install.md", "llms.txt"):
        text = (ROOT / page).read_text("utf-8")
        wheels = re.findall(r"gscompleter-([\d.]+)-py3-none-any\.whl\[([\w,]+)\]", text)
        assert wheels == [(__version__, "poses,film")], page
        assert "pip install '.[poses,film]'" in text, page
        assert not re.search(r"pip install gscompleter(?!\[)", text), page


def test_doctor_says_how_the_cpu_build_is_installed(monkeypatch):
    monkeypatch.setattr("torch.version.cuda", "13.0")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert "torch --index-url https://" in describe_build(Requirement("torch"), "2.13.0")
