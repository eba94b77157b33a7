"""Scripts around the Python interface: modes of torch, wrong values, and `python -m`."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jaxtyping import config as jaxtyping_config

import gscompleter as gsc
from gscompleter import Completion, GSCompleter, InputError
from scenes import Room, camera_at, view_of

CAMERAS = [camera_at(x, size=48) for x in (-0.3, 0.3)]
TARGET = camera_at(0.8, size=48)
LONG = "x" * 300


def complete() -> Completion:
    """Complete the room from two views."""
    return GSCompleter()([view_of(Room(), camera) for camera in CAMERAS], TARGET)


@pytest.fixture(scope="module")
def completion() -> Completion:
    """Complete the room once."""
    return complete()


@pytest.fixture
def unchecked():
    """Let arguments of wrong types through, as for users, who run without these checks."""
    before = jaxtyping_config.jaxtyping_disable
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", before)


def is_same(one: Completion, other: Completion) -> bool:
    """Compare the Gaussians of two completions bit for bit."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return all(torch.equal(getattr(one.scene, n), getattr(other.scene, n)) for n in names)


@pytest.mark.slow
def test_inference_mode_changes_nothing(completion):
    with torch.inference_mode():
        done = complete()
        assert is_same(completion, done)
        assert gsc.judge(done).status == gsc.judge(completion).status
    # What was made there goes on outside of it.
    further = GSCompleter().advance(done, camera_at(-0.8, size=48))
    assert further.targets[1].added is not None


@pytest.mark.slow
def test_float64_as_the_default_type_changes_nothing(completion):
    views = [view_of(Room(), camera) for camera in CAMERAS]
    torch.set_default_dtype(torch.float64)
    try:
        done = GSCompleter()(views, TARGET)
    finally:
        torch.set_default_dtype(torch.float32)
    assert is_same(completion, done)


def test_splats_are_read_and_written_with_float64_as_the_default_type(completion, tmp_path):
    torch.set_default_dtype(torch.float64)
    try:
        for name in ("x.ply", "x.spz", "x.splat"):
            gsc.save_splat(tmp_path / name, completion.scene)
            assert gsc.load_splat(tmp_path / name).means.dtype is torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


WRONG = {
    "advance a number": (lambda d: GSCompleter().advance(3, TARGET), "state .* and is 3"),
    "complete a scene": (
        lambda d: GSCompleter().complete(d.scene, [TARGET]),
        "state .* of type Gaussians",
    ),
    "complete for a number": (lambda d: GSCompleter().complete(d, 3), "targets .* list of cameras"),
    "a batch for a number": (lambda d: GSCompleter().advance_batch(d, 3), "list of cameras"),
    "observe a text": (lambda d: GSCompleter().observe("x", TARGET), "state .* and is 'x'"),
    "judge a number": (lambda d: gsc.judge(3), "state has to be a Completion"),
    "a generator by name": (
        lambda d: GSCompleter(generator="warp-inpaint"),
        r"gsc\.load_generator returns.*'warp-inpaint'",
    ),
    "settings of another kind": (
        lambda d: gsc.CompleterConfig(registration=torch.zeros(3)),
        "registration of a config has to be of RegistrationConfig",
    ),
    "an object as a setting": (
        lambda d: GSCompleter(config=gsc.CompleterConfig(margin=object())),
        "<object object>",
    ),
    "a name of 300 letters": (lambda d: gsc.load_cameras(LONG), "No file can be called"),
    "a zero byte": (lambda d: d.save("a\0b"), "No file can be called"),
    "a tuple as a path": (lambda d: d.save((1, 2)), "A path has to be a str or Path"),
    "a page at a tuple": (lambda d: d.report((1, 2)), "A path has to be a str or Path"),
    "a demo at a number": (lambda d: gsc.write_demo_scene(3), "A path has to be a str or Path"),
    "an image of channels first": (
        lambda d: replace(d.views[0], image=torch.zeros(3, 48, 64)),
        r"shape \[h, w, 3\], and is",
    ),
    "flat harmonics": (
        lambda d: replace(d.scene, sh=torch.zeros(4, 3)),
        r"shape \[n, k, 3\], and is",
    ),
    "Gaussians of numbers": (lambda d: gsc.make_observed(3, 3, 3, 3, 3), "means of Gaussians"),
    "no views": (lambda d: gsc.load_reconstructor("plane-sweep")([]), "No view was given"),
    "a number as views": (lambda d: gsc.load_reconstructor("plane-sweep")(3), "have to be a list"),
}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.usefixtures("unchecked")
def test_a_wrong_value_is_refused_in_a_sentence(completion, kind):
    call, sentence = WRONG[kind]
    with pytest.raises(InputError, match=sentence) as error:
        call(completion)
    assert not re.search(r"0x[0-9a-f]+", str(error.value))


def test_a_folder_that_is_not_there_is_named_when_a_splat_is_saved(completion, tmp_path):
    with pytest.raises(InputError, match=r"there is no folder .*missing; make it"):
        gsc.save_ply(tmp_path / "missing" / "x.ply", completion.scene)


def test_a_config_is_named_by_a_path_too():
    assert gsc.load_config(Path("paper")) == gsc.load_config("paper")


def test_the_package_runs_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "gscompleter", "--version"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.strip()) == (0, gsc.__version__)
