"""Models of ffgs as Ψ, with a stand-in for its package: inputs, frames, and refusals."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest
import torch

from command import run
from gscompleter import GSCompleter, InputError, load_reconstructor
from gscompleter.reconstructors import check_reconstructor, run_reconstructor
from scenes import Room, camera_at, gaussians_of, view_of

SIZE, SCALE = 48, 0.4
VIEWS = [view_of(Room(), camera_at(x, size=SIZE), n) for n, x in enumerate((-0.3, 0.1))]
VARIANT = "tokengs/dl3dv-2v"


@dataclass
class Views:
    """Unbatched images, intrinsics and poses, as the package takes them."""

    images: torch.Tensor
    intrinsics: torch.Tensor
    c2w: torch.Tensor


class Output:
    """Gaussians of the model in its own frame, that of the first camera at `SCALE`."""

    def __init__(self, c2w: torch.Tensor, degree: int) -> None:
        self.anchor = c2w[0]
        self.degree = degree

    def to_world(self):
        truths = [gaussians_of(view) for view in VIEWS]
        join = lambda name: torch.cat([getattr(t, name) for t in truths])[None]  # noqa: E731
        count = sum(map(len, truths))
        sh = torch.zeros(1, count, (self.degree + 1) ** 2, 3)
        sh[:, :, 0] = join("sh")[:, :, 0]
        opacities = join("opacities")
        opacities[:, :5] = 0  # the padding of a batch
        means = join("means")
        means[:, 5] = torch.nan
        return SimpleNamespace(
            gaussians=SimpleNamespace(
                means=means,
                quats=3 * join("quats"),
                scales=join("scales"),
                opacities=opacities,
                sh=lambda: sh,
            )
        )


class Pipeline:
    """Remembers what it is given."""

    degree = 4

    def __init__(self) -> None:
        self.given: list[Views] = []

    @classmethod
    def from_pretrained(cls, place, *, device):
        if place != VARIANT and not place.endswith("folder"):
            raise KeyError(f"no zoo entry {place!r}")
        return cls()

    def __call__(self, views: Views) -> Output:
        if views.images.shape[0] < 2:
            raise ValueError("fitting a frame to given poses needs at least 2 views")
        self.given.append(views)
        return Output(views.c2w, self.degree)


@pytest.fixture
def package(monkeypatch):
    module = ModuleType("ffgs")
    module.__spec__ = ModuleSpec("ffgs", None)
    module.GSPipeline = Pipeline
    module.Views = Views
    monkeypatch.setitem(sys.modules, "ffgs", module)


def test_the_model_gets_images_and_cameras_and_gives_a_scene(package):
    psi = load_reconstructor(f"ffgs:{VARIANT}")
    found = run_reconstructor(psi, VIEWS)
    (given,) = psi.pipeline.given
    assert given.images.shape == (2, 3, SIZE, SIZE)
    assert torch.equal(given.images[1].permute(1, 2, 0), VIEWS[1].image)
    assert torch.equal(given.intrinsics[0], VIEWS[0].camera.K)
    assert torch.equal(given.c2w[1], VIEWS[1].camera.c2w)

    # Padding and NaN are left out; harmonics end with degree 3; quaternions are of length 1.
    truth = sum(len(gaussians_of(view)) for view in VIEWS)
    assert len(found.gaussians) == truth - 6
    assert found.gaussians.sh_degree == 3
    assert torch.allclose(found.gaussians.quats.norm(dim=1), torch.ones(truth - 6))
    for view, depth in zip(VIEWS, found.depths, strict=True):
        error = (depth.depth / view.depth - 1).abs()[depth.valid]
        assert depth.valid.float().mean() > 0.9
        assert error.median() < 0.05


def test_a_scene_is_completed_with_it(package, tmp_path):
    (tmp_path / "folder").mkdir()
    psi = load_reconstructor(f"ffgs:{VARIANT}", tmp_path / "folder")
    done = GSCompleter(reconstructor=psi)(VIEWS, camera_at(0.7, yaw=12, size=SIZE))
    assert len(done.added) > 0


def test_images_of_two_sizes_are_cropped_with_their_cameras(package):
    psi = load_reconstructor(f"ffgs:{VARIANT}")
    K = VIEWS[0].camera.K.clone()
    K[:2, 2] += 4
    padded = replace(VIEWS[0].camera, K=K, width=SIZE + 8, height=SIZE + 8)
    run_reconstructor(psi, [view_of(Room(), padded), VIEWS[1]])
    (given,) = psi.pipeline.given
    assert given.images.shape == (2, 3, SIZE, SIZE)
    assert torch.allclose(given.images[0].permute(1, 2, 0), VIEWS[0].image, atol=1e-4)
    assert torch.allclose(given.intrinsics[0], VIEWS[0].camera.K)


def test_what_the_package_refuses_is_one_sentence(package, tmp_path):
    psi = load_reconstructor(f"ffgs:{VARIANT}")
    with pytest.raises(InputError, match="needs at least 2 views"):
        psi(VIEWS[:1])
    with pytest.raises(InputError, match="did not load none/such"):
        load_reconstructor("ffgs:none/such")
    with pytest.raises(InputError, match="There are no weights at some/where"):
        load_reconstructor(f"ffgs:{VARIANT}", "some/where")
    (tmp_path / "mine.pt").touch()
    with pytest.raises(InputError, match=r"mine\.pt is no folder"):
        load_reconstructor(f"ffgs:{VARIANT}", tmp_path / "mine.pt")


def test_weights_that_cannot_be_loaded_are_no_fault_of_the_name(package, tmp_path):
    for weights, option in ((tmp_path, "weights"), (None, "reconstructor")):
        with pytest.raises(InputError, match="did not load") as error:
            load_reconstructor("ffgs:none/such", weights)
        assert error.value.argument == option


def test_a_gaussian_that_no_scene_can_have_is_left_out(package, monkeypatch):
    """A rotation of length 0 and a huge harmonic, as NaN; the others are a scene."""
    to_world = Output.to_world

    def spoil(output):
        found = to_world(output)
        found.gaussians.quats[:, 10] = 0
        found.gaussians.sh()[:, 11] = 1e30
        return found

    psi = load_reconstructor(f"ffgs:{VARIANT}")
    whole = len(run_reconstructor(psi, VIEWS).gaussians)
    monkeypatch.setattr(Output, "to_world", spoil)
    assert len(run_reconstructor(psi, VIEWS).gaussians) == whole - 2


def test_without_the_package_its_command_is_named(monkeypatch, capsys, room, tmp_path):
    monkeypatch.setitem(sys.modules, "ffgs", None)
    words = ("complete", room, "--out", tmp_path / "o", "--reconstructor", f"ffgs:{VARIANT}")
    assert run(monkeypatch, *words) == 2
    assert "pip install --pre ffgs" in capsys.readouterr().err


def test_names_are_checked_before_anything_is_loaded():
    check_reconstructor(f"ffgs:{VARIANT}")
    for name in ("ffgs", "ffgs:", "other:x/y"):
        with pytest.raises(InputError, match="ffgs:FAMILY/VARIANT"):
            check_reconstructor(name)
