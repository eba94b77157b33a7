"""The viewer page without a browser: its content, its limits, and its server."""

import base64
import hashlib
import http.client
import io
import json
import re
import shutil
import socket
import struct
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import plyfile
import pytest
import torch
from PIL import Image

from command import run
from gscompleter.apps.report.schema import (
    AlignmentRow,
    CompletionSummary,
    ContextRow,
    OpenedSceneRow,
    ResultFrame,
    TargetRow,
)
from gscompleter.apps.viewer import packages
from gscompleter.apps.viewer import page as pages
from gscompleter.apps.viewer.exhibit import (
    ViewerCamera,
    ViewerContent,
    add_file_cameras,
    load_viewer_completion,
    load_viewer_files,
    make_frame_thumbnail,
)
from gscompleter.apps.viewer.packages import (
    MODULES,
    Libraries,
    NpmPackage,
    extract_libraries,
    get_archive,
    get_archive_path,
    load_libraries,
    read_lock,
)
from gscompleter.apps.viewer.page import make_page
from gscompleter.apps.viewer.serving import make_page_server
from gscompleter.data.formats import open_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.data.sfm.refined_file import write_refined
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.evaluation.metrics.coverage import Coverage
from gscompleter.evaluation.verdict.rows import OutcomeRow
from gscompleter.splats.formats import load_splat
from gscompleter.splats.ply import save_ply
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import ORIENTATION, write_image
from gscompleter.types import Gaussians, merge
from pose_files import CAMERAS, NAMES, write_colmap_binary, write_photographs
from scenes import camera_at
from viewer_pages import LEFT, NONE, SIDE, TARGET, content_of, room_exhibit, room_from


def gaussians_in(page: bytes, layer: str, folder: Path) -> Gaussians:
    """Read a layer of a page."""
    calls = re.findall(rb'gscPart\("(\w+)", "([^"]*)"\)', page)
    source = content_of(page)["layers"][layer].encode()
    path = folder / f"{layer}.spz"
    path.write_bytes(b"".join(base64.b64decode(text) for name, text in calls if name == source))
    return load_splat(path)


# ---------------------------------------------------------------------------------- packages


@pytest.fixture
def registry(tmp_path, monkeypatch) -> Path:
    """Return the lock of a registry that is a folder, with a cache that is empty."""
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(packages, "REGISTRY", (tmp_path / "registry").as_uri())
    files: dict[str, dict[str, str]] = {}
    for package, file in MODULES.values():
        files.setdefault(package, {"LICENSE": f"of {package}"})[file] = f"// {package} {file}"
    files["three"]["build/three.module.min.js"] += ' import "./three.core.min.js";'
    entries = {"": {}}
    for name, contents in files.items():
        archive = archive_in(tmp_path, NpmPackage(name, "1.2.3", ""))
        archive.parent.mkdir(parents=True)
        with tarfile.open(archive, "w:gz") as packed:
            for file, text in contents.items():
                entry = tarfile.TarInfo(f"package/{file}")
                entry.size = len(text)
                packed.addfile(entry, io.BytesIO(text.encode()))
        digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
        entries[f"node_modules/{name}"] = {"version": "1.2.3", "integrity": f"sha512-{digest}"}
    lock = tmp_path / "package-lock.json"
    lock.write_text(json.dumps({"lockfileVersion": 3, "packages": entries}))
    return lock


def archive_in(folder: Path, package: NpmPackage) -> Path:
    """Get the path of an archive in the registry of a test."""
    return folder / "registry" / package.path


def three_of(lock: Path) -> NpmPackage:
    return next(package for package in read_lock(lock) if package.name == "three")


def test_the_lock_pins_every_package_by_its_hash():
    pinned = read_lock(packages.LOCK_FILE)
    assert {package.name for package in pinned} == {"three", "@sparkjsdev/spark", "fflate"}
    for package in pinned:
        assert package.path.endswith(f"-{package.version}.tgz")
        assert len(base64.b64decode(package.integrity.removeprefix("sha512-"))) == 64


def test_modules_and_licences_come_out_of_the_archives(registry):
    libraries = extract_libraries(registry)
    assert libraries.modules.keys() == MODULES.keys()
    assert libraries.licences["three 1.2.3"] == "of three"
    assert 'import "three-core"' in libraries.modules["three"]


def test_an_archive_is_fetched_once(registry):
    three = three_of(registry)
    archive = get_archive(three)
    archive_in(registry.parent, three).unlink()
    assert get_archive_path(three).read_bytes() == archive
    assert get_archive(three) == archive


def test_an_archive_that_was_tampered_with_is_refused_and_not_kept(registry):
    three = three_of(registry)
    source = archive_in(registry.parent, three)
    source.write_bytes(source.read_bytes() + b"\0")
    with pytest.raises(InputError, match="its SHA-512 differs"):
        get_archive(three)
    assert not get_archive_path(three).exists()


def test_a_connection_that_ends_midway_is_one_sentence(registry, monkeypatch):
    class CutAnswer(io.BytesIO):
        def read(self):
            raise http.client.IncompleteRead(self.getvalue(), 1000)

    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: CutAnswer(b"1f8b"))
    with pytest.raises(InputError) as refused:
        get_archive(three_of(registry))
    # In full, because folders of a test may be long.
    assert "it cannot be fetched" in refused.value.args[0]


def test_a_damaged_archive_in_the_cache_is_fetched_again(registry):
    three = three_of(registry)
    archive = get_archive(three)
    get_archive_path(three).write_bytes(archive[:-9])
    assert get_archive(three) == archive
    assert get_archive_path(three).read_bytes() == archive


def test_without_a_connection_a_sentence_says_where_to_put_what(registry):
    three = three_of(registry)
    archive_in(registry.parent, three).unlink()
    with pytest.raises(InputError) as refused:
        get_archive(three)
    sentence = refused.value.args[0]  # in full, because folders of a test may be long
    assert "cannot be fetched" in sentence
    assert three.path in sentence
    assert str(get_archive_path(three)) in sentence


def test_a_wheel_needs_no_connection(registry, tmp_path, monkeypatch):
    libraries, built = extract_libraries(registry), tmp_path / "libraries.json"
    built.write_text(json.dumps(vars(libraries)))
    monkeypatch.setattr(packages, "BUILT_LIBRARIES", built)
    monkeypatch.setattr(packages, "LOCK_FILE", tmp_path / "nowhere")
    assert load_libraries() == libraries


# ---------------------------------------------------------------------------------- the page


def test_the_same_values_give_the_same_bytes():
    assert make_page(room_exhibit(), NONE) == make_page(room_exhibit(), NONE)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_a_page_holds_the_gaussians_whatever_their_unit(tmp_path, unit):
    camera = camera_at(size=32, unit=unit)
    observed, generated = room_from(camera, 0, unit), room_from(camera, 1, unit)
    page, _ = make_page(ViewerContent("room", merge([observed, generated]), None), NONE)
    frame = content_of(page)["frame"]
    held = gaussians_in(page, "generated", tmp_path)
    means = held.means.double() * frame["unit"] + torch.tensor(frame["centre"])
    scale = generated.means.abs().max()
    assert (means - generated.means).abs().max() < 1e-4 * scale
    ratio = held.scales * frame["unit"] / generated.scales
    assert ratio.log().abs().max() < 1 / 16  # the steps of a .spz are 1/16


def test_what_did_not_change_is_held_once():
    layers = content_of(make_page(room_exhibit(), NONE)[0])["layers"]
    assert layers == {"before": "observed", "observed": "observed", "generated": "generated"}


def test_the_page_knows_which_layers_are_antialiased():
    exhibit = room_exhibit()
    marked = replace(exhibit, after=replace(exhibit.after, is_antialiased=True))
    content = content_of(make_page(marked, NONE)[0])
    assert content["antialiased"] == {"before": False, "observed": True, "generated": True}
    assert content["layers"]["before"] == "before"


def test_what_changed_is_held_beside_what_it_became(tmp_path):
    exhibit = room_exhibit()
    assert exhibit.before is not None
    page, _ = make_page(replace(exhibit, before=exhibit.before[:100]), NONE)
    assert len(gaussians_in(page, "before", tmp_path)) == 100
    assert content_of(page)["layers"]["before"] == "before"


def test_text_from_outside_cannot_leave_its_place():
    evil = "</script><script>alert(1)</script><!--"
    shot = ViewerCamera("target-1", evil, TARGET, notes=(evil,))
    page, _ = make_page(replace(room_exhibit(evil), cameras=(shot,)), Libraries({}, {evil: evil}))
    text = page.decode()
    assert evil not in text
    assert "alert(1)</script" not in text
    content = content_of(page)
    assert (
        content["title"] == content["shots"][0]["title"] == content["shots"][0]["notes"][0] == evil
    )
    assert content["licences"] == {evil: evil}


def test_our_program_writes_text_and_never_markup():
    program = pages.read_program()
    assert "textContent" in program
    for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("):
        assert way not in program


def test_a_page_names_nothing_outside_of_itself():
    text = make_page(room_exhibit(), NONE)[0].decode()
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")
    assert not re.search(r"\b(src|href)=", text)


def test_a_large_scene_is_held_in_parts(tmp_path, monkeypatch):
    whole, _ = make_page(room_exhibit(), NONE)
    monkeypatch.setattr(pages, "MAX_SCRIPT_BYTES", 20_000)
    page, _ = make_page(room_exhibit(), NONE)
    assert page.count(b'gscPart("') > 2
    for layer in ("observed", "generated"):
        assert torch.equal(
            gaussians_in(page, layer, tmp_path).means, gaussians_in(whole, layer, tmp_path).means
        )


def test_floaters_beyond_all_measure_are_left_out_and_counted():
    exhibit = room_exhibit()
    means = exhibit.after.means.clone()
    means[:3] = 1e9
    floating = replace(exhibit, after=replace(exhibit.after, means=means), before=None)
    page, notes = make_page(floating, NONE)
    assert notes == ("3 Gaussians are too far away to be shown.",)
    assert content_of(page)["counts"]["observed"] == SIDE * SIDE - 3


def test_a_scene_without_cameras_has_one_that_sees_it():
    exhibit = replace(room_exhibit(), cameras=())
    (shot,) = content_of(make_page(exhibit, NONE)[0])["shots"]
    assert shot["name"] == "overview"
    pose = np.array(shot["pose"]).reshape(4, 4)
    # It looks along -z of the page at its origin, which is the middle of the scene.
    assert np.array_equal(pose[:3, :3], np.eye(3))
    assert abs(pose[2, 3] - shot["focus"]) < 0.5 * shot["focus"]


@pytest.mark.parametrize("size", [1e-4, 1.0, 300.0])
def test_gaussians_in_one_place_are_seen_from_outside(size):
    """Their distances do not tell how large they are, in whatever unit."""
    one = room_exhibit().after[:1]
    one = replace(one, means=one.means + 5, scales=torch.full_like(one.scales, size))
    for count in (1, 3):
        exhibit = ViewerContent("one", one[torch.zeros(count, dtype=torch.long)], None)
        content = content_of(make_page(exhibit, NONE)[0])
        pose = np.array(content["shots"][0]["pose"]).reshape(4, 4)
        shown = size / content["frame"]["unit"]
        assert pose[2, 3] > 4 * shown
        assert 1 < shown < 8


def test_a_camera_looks_as_far_as_what_it_sees():
    content = content_of(make_page(room_exhibit(), NONE)[0])
    depth = room_from(LEFT, 0).means.double() - LEFT.center
    expected = (depth @ LEFT.forward.double()).median().item()
    focus = content["shots"][1]["focus"] * content["frame"]["unit"]
    assert abs(focus - expected) < 0.2 * expected


# ---------------------------------------------------------------------------------- exhibits


def test_a_scene_alone_is_compared_with_what_was_observed(tmp_path):
    exhibit = room_exhibit()
    save_ply(tmp_path / "completed.ply", exhibit.after)
    found = load_viewer_files(tmp_path / "completed.ply", None, drop_nonfinite=False)
    assert found.before is not None
    assert exhibit.before is not None
    assert torch.equal(found.before.means, exhibit.before.means)


@pytest.mark.parametrize("generated", [0, 1])
def test_a_scene_of_one_kind_is_compared_with_nothing(tmp_path, generated):
    save_ply(tmp_path / "a.ply", room_from(LEFT, generated))
    found = load_viewer_files(tmp_path / "a.ply", None, drop_nonfinite=False)
    assert found.before is None
    assert "before" not in content_of(make_page(found, NONE)[0])["layers"]


def completion_in(folder: Path, transform: np.ndarray, origin: np.ndarray) -> Path:
    """Write an output folder of `complete` with cameras in another frame than its scenes."""
    exhibit = room_exhibit()
    folder.mkdir()
    (folder / "images").mkdir()
    assert exhibit.before is not None
    save_ply(folder / "context.ply", exhibit.before)
    save_ply(folder / "completed.ply", exhibit.after)
    write_image(folder / "images" / "target1_after.png", torch.rand(SIDE, SIDE, 3))
    back = np.linalg.inv(transform)
    c2w = torch.from_numpy(back) @ TARGET.c2w.double()
    write_cameras(folder / "targets.json", [replace(TARGET, c2w=c2w, K=TARGET.K.double())])
    scores = [None] * 4
    fit = AlignmentRow(1.0, 0.0, 1.0, "ransac")
    row = TargetRow(None, *scores, 0, False, 0.5, fit, 1, notes=("a <note>",))
    summary = CompletionSummary(
        version="0.0.1",
        settings={"folder": str(folder / "gone")},
        seed=0,
        device="cpu",
        scene=OpenedSceneRow("nerfstudio", 1, 1),
        outcome=OutcomeRow("completed", "The scene is completed."),
        frame=ResultFrame("similarity", tuple(map(tuple, transform.tolist())), tuple(origin)),
        depth_range={},
        coverage=Coverage(0.5, 1.0, 32),
        context=(ContextRow(0, *scores),),
        targets=(row,),
        gaussians={"context": 1, "added": 1},
        seconds={},
    )
    (folder / "summary.json").write_text(json.dumps(summary, default=vars))
    return folder


def test_the_targets_of_a_completion_are_brought_into_the_frame_of_its_scenes(tmp_path):
    """Maps have coordinates beyond the precision of float32: the origin is subtracted first."""
    origin = np.array([5e6, -3e6, 1e3])
    transform = np.eye(4)
    transform[:3, 3] = -origin
    exhibit = load_viewer_completion(completion_in(tmp_path / "out", transform, origin), False)
    (shot,) = exhibit.cameras
    assert shot.name == "target-1"
    assert shot.notes == ("a <note>",)
    assert shot.thumbnail is not None
    assert (shot.camera.c2w - TARGET.c2w).abs().max() < 1e-5
    assert "gone" in exhibit.notes[0]


def test_a_completion_whose_input_splat_is_gone_is_shown_alone_with_a_note(tmp_path):
    """With `--save-as` that splat is the scene before, and its user may move it."""
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    splat = (folder / "context.ply").rename(tmp_path / "input.ply")
    change_summary(folder, "scene", "context", str(splat))
    assert load_viewer_completion(folder, False).before is not None
    splat.unlink()
    exhibit = load_viewer_completion(folder, False)
    assert [shot.name for shot in exhibit.cameras] == ["target-1"]
    assert exhibit.notes[0].startswith("The scene before is not shown")
    assert str(splat) in exhibit.notes[0]
    assert "before" not in content_of(make_page(exhibit, NONE)[0])["layers"]


def test_photographs_of_a_completion_are_jumped_to(tmp_path):
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    (folder / "gone").mkdir()
    write_image(folder / "gone" / "0.png", torch.rand(SIDE, SIDE, 3))
    write_cameras(folder / "gone" / "transforms.json", [LEFT], ["0.png"])
    exhibit = load_viewer_completion(folder, False)
    assert [shot.name for shot in exhibit.cameras] == ["target-1", "photograph-0"]
    assert exhibit.cameras[1].thumbnail is not None
    assert exhibit.notes == ()


def test_photographs_stand_where_their_refined_poses_are(tmp_path):
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    (folder / "gone").mkdir()
    write_image(folder / "gone" / "0.png", torch.rand(SIDE, SIDE, 3))
    write_cameras(folder / "gone" / "transforms.json", [LEFT], ["0.png"])
    given = open_photographs(folder / "gone")
    c2w = given.frames[0].c2w.copy()
    c2w[0, 3] += 0.25
    refined = replace(given, frames=(replace(given.frames[0], c2w=c2w),))
    done = PoseRefinement(1, given_error=0.3, refined_error=0.1, moved=0.05)
    write_refined(folder / "refined_poses.json", given, refined, done)

    # The file of a splat goes along, and says nothing of a result that kept the given poses.
    for used, moved in ((None, 0.0), (vars(done), 0.25)):
        change_summary(folder, "scene", "refined_poses", used)
        shot = load_viewer_completion(folder, False).cameras[1]
        assert shot.camera.center[0] - LEFT.center[0] == pytest.approx(moved, abs=1e-6)


def change_summary(folder: Path, part: str, name: str, value: object) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    summary[part][name] = value
    (folder / "summary.json").write_text(json.dumps(summary))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", [1e300, float("nan"), float("inf"), 0.0])
def test_a_frame_that_is_no_similarity_is_refused_by_its_file(tmp_path, number):
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    transform = np.eye(4)
    transform[0, 0] = number
    change_summary(folder, "frame", "transform", transform.tolist())
    with pytest.raises(InputError, match=r"summary\.json is damaged \(frame: no similarity"):
        load_viewer_completion(folder, False)


@pytest.mark.parametrize("name", [["x"], {"a": 1}, 5, "\ud800"])
def test_photographs_of_an_unknown_format_are_left_out(tmp_path, name):
    """Another program wrote the summary: the scene is shown without its photographs."""
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    (folder / "gone").mkdir()
    change_summary(folder, "settings", "format", name)
    exhibit = load_viewer_completion(folder, False)
    assert [shot.name for shot in exhibit.cameras] == ["target-1"]
    assert "are not shown" in exhibit.notes[0]
    assert "moved" not in exhibit.notes[0]


@pytest.mark.parametrize("path", ["x" * 5000, "\0", "\ud800", ""])
def test_photographs_at_an_impossible_path_are_left_out(tmp_path, monkeypatch, path):
    """Another program wrote the summary."""
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    change_summary(folder, "settings", "folder", path)
    monkeypatch.chdir(tmp_path)
    exhibit = load_viewer_completion(folder, False)
    assert "are not shown" in exhibit.notes[0]


def test_a_note_names_the_photograph_that_is_damaged(tmp_path):
    folder = completion_in(tmp_path / "out", np.eye(4), np.zeros(3))
    (folder / "gone").mkdir()
    write_image(folder / "gone" / "0.png", torch.rand(SIDE, SIDE, 3))
    write_cameras(folder / "gone" / "transforms.json", [LEFT], ["0.png"])
    data = (folder / "gone" / "0.png").read_bytes()
    (folder / "gone" / "0.png").write_bytes(data[: len(data) // 2])
    (note,) = load_viewer_completion(folder, False).notes
    assert "are not shown" in note
    assert "0.png" in note
    assert "moved" not in note


def completion_of_photographs_in(folder: Path) -> Path:
    """Write an output folder of `complete` for photographs without cameras, and move it."""
    completion_in(folder, np.eye(4), np.zeros(3))
    summary = json.loads((folder / "summary.json").read_text())
    summary["scene"]["format"] = "photographs"
    (folder / "summary.json").write_text(json.dumps(summary))
    write_photographs(folder / "colmap" / "images")
    write_colmap_binary(folder / "colmap" / "sparse" / "0")
    return folder


def test_photographs_whose_cameras_were_found_are_jumped_to(tmp_path):
    folder = completion_of_photographs_in(tmp_path / "out")
    exhibit = load_viewer_completion(folder, False)
    assert [shot.name for shot in exhibit.cameras] == ["target-1", "photograph-0"]
    assert exhibit.cameras[1].thumbnail is not None
    assert (exhibit.cameras[1].camera.c2w - CAMERAS[0].c2w).abs().max() < 1e-5
    assert exhibit.notes == ()

    shutil.rmtree(folder / "colmap")
    (remark,) = load_viewer_completion(folder, False).notes
    assert str(folder / "colmap") in remark


def test_a_folder_that_is_no_completion_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"has no summary\.json"):
        load_viewer_completion(tmp_path, False)


# --------------------------------------------------------------------------- the command line


@pytest.fixture
def packed(monkeypatch) -> None:
    """Let the command find its libraries."""
    monkeypatch.setattr("gscompleter.apps.viewer.packages.load_libraries", lambda: NONE)


def test_a_page_is_saved_once(packed, tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", room_exhibit().after)
    asked = ("view", tmp_path / "a.ply", "--save", tmp_path / "page.html")
    assert run(monkeypatch, *asked) == 0
    upward, page = capsys.readouterr().out.splitlines()
    assert upward.startswith("Up is -y, as in most files")
    assert page == str(tmp_path / "page.html")
    first = (tmp_path / "page.html").read_bytes()
    assert run(monkeypatch, *asked) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run(monkeypatch, *asked, "--overwrite") == 0
    assert (tmp_path / "page.html").read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "page.html"]


@pytest.mark.parametrize("content", ['["door", "yard"]', '[{"id": 0, "rotation": 0}]'])
def test_a_list_of_other_cameras_beside_a_splat_keeps_nobody_from_looking(
    packed, tmp_path, monkeypatch, capsys, content
):
    save_ply(tmp_path / "a.ply", room_exhibit().after)
    (tmp_path / "cameras.json").write_text(content)
    page = tmp_path / "page.html"
    assert run(monkeypatch, "view", tmp_path / "a.ply", "--save", page) == 0
    unread, upward, _ = capsys.readouterr().out.splitlines()
    assert unread.startswith("The cameras beside the splat do not tell what is up. ")
    assert "cameras.json" in unread
    assert upward.startswith("Up is -y, as in most files")


def test_the_second_scene_is_the_one_after(packed, tmp_path, monkeypatch):
    exhibit = room_exhibit()
    assert exhibit.before is not None
    save_ply(tmp_path / "a.ply", exhibit.before[:50])
    save_ply(tmp_path / "b.ply", exhibit.after)
    page = tmp_path / "page.html"
    assert run(monkeypatch, "view", tmp_path / "a.ply", tmp_path / "b.ply", "--save", page) == 0
    counts = content_of(page.read_bytes())["counts"]
    assert counts == {"before": 50, "observed": SIDE * SIDE, "generated": SIDE * SIDE}


def test_cameras_bring_their_photographs_as_thumbnails(packed, tmp_path, monkeypatch):
    save_ply(tmp_path / "a.ply", room_exhibit().after)
    write_image(tmp_path / "left.png", torch.rand(SIDE, SIDE, 3))
    write_cameras(tmp_path / "transforms.json", [LEFT, TARGET], ["left.png", "gone.png"])
    page = tmp_path / "page.html"
    cameras = ("--cameras", tmp_path / "transforms.json")
    assert run(monkeypatch, "view", tmp_path / "a.ply", *cameras, "--save", page) == 0
    shots = content_of(page.read_bytes())["shots"]
    assert [(shot["name"], shot["title"]) for shot in shots] == [
        ("camera-1", "left.png"),
        ("camera-2", "gone.png"),
    ]
    assert shots[0]["thumbnail"] is not None
    assert shots[1]["thumbnail"] is None


def test_cameras_of_another_machine_are_called_by_the_names_of_their_photographs(tmp_path):
    paths = ["images\\left.png", "C:\\Users\\me\\scan\\gone.png"]
    write_cameras(tmp_path / "transforms.json", [LEFT, TARGET], paths)
    content = add_file_cameras(room_exhibit(), tmp_path / "transforms.json", None)
    assert [camera.title for camera in content.cameras[-2:]] == ["left.png", "gone.png"]


def test_cameras_of_a_colmap_folder_are_jumped_to(packed, tmp_path, monkeypatch):
    folder, page = completion_of_photographs_in(tmp_path / "out"), tmp_path / "page.html"
    (folder / "colmap" / "images" / NAMES[1]).unlink()
    cameras = ("--cameras", folder / "colmap")
    assert run(monkeypatch, "view", folder, *cameras, "--save", page) == 0
    shots = content_of(page.read_bytes())["shots"]
    found = [shot for shot in shots if shot["name"].startswith("camera-")]
    assert [shot["title"] for shot in found] == NAMES
    assert [shot["thumbnail"] is None for shot in found] == [False, True, False, False, False]


def header_only(path: Path) -> None:
    """Write a .ply without any Gaussian."""
    save_ply(path, room_from(LEFT, 0)[:1])
    head = path.read_bytes().split(b"end_header\n")[0].replace(b"vertex 1\n", b"vertex 0\n")
    path.write_bytes(head + b"end_header\n")


def with_nan(path: Path) -> None:
    save_ply(path, room_from(LEFT, 0))
    content = plyfile.PlyData.read(path, mmap=False)
    content["vertex"].data["x"][0] = np.nan
    content.write(path)


@pytest.mark.parametrize(
    ("write", "said"), [(header_only, "holds no Gaussian"), (with_nan, "--drop-nonfinite")]
)
def test_what_cannot_be_shown_gets_a_sentence(packed, tmp_path, monkeypatch, capsys, write, said):
    write(tmp_path / "a.ply")
    assert run(monkeypatch, "view", tmp_path / "a.ply", "--save", tmp_path / "page.html") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_a_direction_that_is_none_is_refused_before_anything_is_read(monkeypatch, tmp_path, capsys):
    def load() -> None:
        pytest.fail("The libraries are loaded.")

    monkeypatch.setattr("gscompleter.apps.viewer.packages.load_libraries", load)
    asked = ("view", tmp_path / "gone.ply", "--up", 0, 0, 0)
    assert run(monkeypatch, *asked) == 2
    assert "not all zero" in capsys.readouterr().err
    page = tmp_path / "page.html"
    assert run(monkeypatch, *asked, "--save", page) == 2
    assert not page.exists()


def test_a_page_has_to_be_named_as_one(packed, tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", room_from(LEFT, 0))
    assert run(monkeypatch, "view", tmp_path / "a.ply", "--save", tmp_path / "page.ply") == 2
    assert "*.html" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("--save", "page.html", "--port", 8080), ("--save", "page.html", "--no-open")]
)
def test_a_page_that_is_saved_is_served_nowhere(packed, tmp_path, monkeypatch, capsys, words):
    save_ply(tmp_path / "a.ply", room_from(LEFT, 0))
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "view", "a.ply", *words) == 2
    assert f"not served; leave this out, or --save ({words[2]})" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_a_page_that_is_served_replaces_no_file(packed, tmp_path, monkeypatch, capsys):
    save_ply(tmp_path / "a.ply", room_from(LEFT, 0))

    def stop(_: str) -> None:  # else a page that is served would never end
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", stop)
    assert run(monkeypatch, "view", tmp_path / "a.ply", "--overwrite") == 2
    assert "name the file of the page with --save" in capsys.readouterr().err


def test_without_a_file_to_save_to_the_page_is_served_and_opened(
    packed, tmp_path, monkeypatch, capsys
):
    """Ctrl-C, which ends it, comes as soon as the browser is opened."""
    save_ply(tmp_path / "a.ply", room_exhibit().after)
    answers = []

    def opened(address: str) -> None:
        answers.append(urlsplit(address))
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", opened)
    assert run(monkeypatch, "view", tmp_path / "a.ply") == 0
    (address,) = answers
    assert address.hostname == "127.0.0.1"
    assert address.geturl() in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


# ---------------------------------------------------------------------------------- the server


POLL_SECONDS = 0.01
"""Time in which a server notices that it is shut down; Python's is half a second."""


@pytest.fixture
def port() -> Iterator[int]:
    """Return the port of a server of a page."""
    with make_page_server(b"<!doctype html>") as server:
        thread = threading.Thread(target=server.serve_forever, args=(POLL_SECONDS,))
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


def answer(port: int, method: str, path: str, host: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request(method, path, headers={"Host": host})
    response = connection.getresponse()
    return response.status, response.read()


@pytest.mark.parametrize("host", ["127.0.0.1:1234", "localhost", "LOCALHOST:80"])
def test_this_machine_gets_the_page(port, host):
    assert answer(port, "GET", "/", host) == (200, b"<!doctype html>")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:80", "", "[::1]"])
def test_a_site_that_points_its_name_here_gets_nothing(port, host):
    status, body = answer(port, "GET", "/", host)
    assert status == 421
    assert b"<!doctype html>" not in body.splitlines()[:1]


@pytest.mark.parametrize("path", ["/../pyproject.toml", "/%2e%2e/a", "/page.html", "//etc/passwd"])
def test_nothing_else_is_served(port, path):
    assert answer(port, "GET", path, "localhost")[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "HEAD"])
def test_nothing_can_be_sent(port, method):
    assert answer(port, method, "/", "localhost")[0] == 501


def test_a_browser_that_leaves_leaves_no_traceback(monkeypatch, capfd):
    """The page is larger than what fits between both programs."""
    with make_page_server(bytes(2**26)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(POLL_SECONDS,))
        thread.start()
        for _ in range(3):
            with socket.create_connection(server.server_address) as browser:
                browser.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
                assert browser.recv(1)
                # Closed with a reset, as by a browser that is ended.
                linger = struct.pack("ii", 1, 0)
                browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        server.shutdown()
        thread.join()
    assert capfd.readouterr().err == ""


def test_a_port_that_is_taken_gets_a_sentence(port):
    with pytest.raises(InputError, match=f"Port {port}"):
        make_page_server(b"", port)


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_the_thumbnail_of_a_single_photograph_is_upright(tmp_path, orientation):
    pixels = np.zeros((32, 48, 3), np.uint8)
    pixels[:16, :24] = 255
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    photographs = open_photographs(tmp_path / "a.png")
    shown = make_frame_thumbnail(photographs.frame(0))
    assert shown is not None
    thumbnail = np.asarray(Image.open(io.BytesIO(shown))).astype(int)
    (view,) = photographs.views([0])
    assert np.abs(thumbnail - 255 * view.image.numpy()).mean() < 8
