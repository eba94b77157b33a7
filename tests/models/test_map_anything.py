"""MapAnything as Ψ, with a stand-in for its package: inputs, units, and refusals."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

import pytest
import torch

from gscompleter import InputError, load_reconstructor
from gscompleter.models import packages
from gscompleter.models.map_anything import PUBLISHED
from scenes import Room, camera_at, view_of

SIZE, UNIT = 70, 2.5
VIEWS = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.2, 0.2)]


class StandIn:
    """Knows the true depth, and answers in units of its own, seen from its first camera."""

    def __init__(self, place: str) -> None:
        if place != PUBLISHED and not place.endswith("here"):
            raise OSError("nothing there")
        self.inputs: list[dict] = []

    from_pretrained = classmethod(lambda kind, place: kind(place))
    to = lambda self, device: self  # noqa: E731
    eval = lambda self: self  # noqa: E731

    @torch.inference_mode()  # as the package answers
    def infer(self, inputs, use_amp, apply_mask):
        assert (use_amp, apply_mask) == (False, False)
        self.inputs = inputs
        first = inputs[0]["camera_poses"][0].inverse()
        answers = []
        for view, given in zip(VIEWS, inputs, strict=True):
            height, width = given["img"].shape[-2:]
            layers = torch.nn.functional.interpolate(view.depth[None, None], (height, width))
            solid = torch.ones(1, height, width, dtype=torch.bool)
            solid[:, : height // 5] = False
            pose = first @ given["camera_poses"][0]
            pose[:3, 3] *= UNIT
            answers.append({
                "depth_z": UNIT * layers[:, 0, ..., None],
                "conf": torch.full((1, height, width), 4.0),
                "non_ambiguous_mask": solid,
                "camera_poses": pose[None],
            })  # fmt: skip
        return answers


@pytest.fixture
def package(monkeypatch):
    for name in ("mapanything", "mapanything.models"):
        module = ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["mapanything.models"].MapAnything = StandIn


def exhaust(name: str) -> None:
    raise MemoryError


def test_depths_come_in_the_unit_of_the_cameras(package):
    psi = load_reconstructor("mapanything")
    depths = psi.model(VIEWS)
    for depth, view in zip(depths, VIEWS, strict=True):
        assert 0.6 < depth.valid.float().mean() < 0.9  # nothing is solid at the top
        error = (depth.depth / view.depth - 1).abs()[depth.valid]
        assert error.median() < 0.01
        assert depth.confidence[depth.valid].unique().tolist() == [0.75]
    inputs = psi.model.model.inputs
    assert [one["img"].shape for one in inputs] == [(1, 3, 518, 518)] * 2
    assert [one["data_norm_type"] for one in inputs] == [["dinov2"]] * 2
    for one, view in zip(inputs, VIEWS, strict=True):
        assert torch.allclose(one["camera_poses"][0], view.camera.c2w)
        assert one["intrinsics"][0, 0, 0] == pytest.approx(view.camera.K[0, 0] * 518 / SIZE)
        assert not one["is_metric_scale"].any()


@pytest.mark.parametrize("number", [0.0, float("nan")])
def test_cameras_without_distances_have_no_scale(package, monkeypatch, number):
    infer = StandIn.infer

    def answer(model, *inputs, **options):
        answers = infer(model, *inputs, **options)
        return [{**one, "camera_poses": number * one["camera_poses"]} for one in answers]

    monkeypatch.setattr(StandIn, "infer", answer)
    with pytest.raises(InputError, match="tells no distances between the 2 cameras"):
        load_reconstructor("mapanything")(VIEWS)


def test_a_scene_is_reconstructed(package, tmp_path):
    (tmp_path / "here").mkdir()
    made = load_reconstructor("mapanything", tmp_path / "here")(VIEWS)
    assert len(made.gaussians) == 2 * SIZE * SIZE


def test_what_is_missing_is_told(package, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="was not loaded from .*test_what_is_missing"):
        load_reconstructor("mapanything", tmp_path)
    # The package would search the hub for a repository of this name.
    with pytest.raises(InputError, match="There are no weights at some/where; correct the path"):
        load_reconstructor("mapanything", "some/where")
    # As it would for a file, such as models/mine.pt: a repository of a user called models.
    file = tmp_path / "mine.pt"
    file.touch()
    with pytest.raises(InputError, match=r"mine\.pt is no folder; name the folder"):
        load_reconstructor("mapanything", file)
    # The package is there: what lacks is memory, of which the command has a sentence of its own.
    with monkeypatch.context() as scarce, pytest.raises(MemoryError):
        scarce.setattr(packages, "import_module", exhaust)
        load_reconstructor("mapanything")
    monkeypatch.setitem(sys.modules, "mapanything.models", None)
    with pytest.raises(InputError, match=r"needs its package: pip install .*\(.*halted"):
        load_reconstructor("mapanything")
