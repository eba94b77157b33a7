"""Models of users that return what no scene can be: one sentence each, before anything is added."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from jaxtyping import config as jaxtyping_config

from gscompleter import Gaussians, GSCompleter, InputError
from gscompleter.generators import GeneratorOutput
from gscompleter.types import DepthMap, Reconstruction, View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 32
VIEWS = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1)]
TARGET = camera_at(0.7, size=SIZE, yaw=12)


@pytest.fixture(autouse=True)
def without_type_checks_of_tests():
    """Users run without them."""
    before = jaxtyping_config.jaxtyping_disable
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", before)


def reconstruct(views) -> Reconstruction:
    """Reconstruct a room whose true depth is known."""
    truths = [view_of(Room(), view.camera) for view in views]
    counts = torch.tensor([truth.depth.numel() for truth in truths])
    return Reconstruction(
        merge([gaussians_of(truth) for truth in truths]),
        tuple(DepthMap(truth.depth, truth.depth > 0) for truth in truths),
        torch.arange(2).repeat_interleave(counts),
        torch.cat([torch.arange(count) for count in counts.tolist()]),
        torch.ones(2, 3),
    )


def paint(nearest: View, target, context) -> torch.Tensor:
    return torch.full((target.height, target.width, 3), 0.5)


def complete(reconstructor=reconstruct, generator=paint):
    completer = GSCompleter(reconstructor=reconstructor, generator=generator)
    return completer(VIEWS, TARGET)


def test_models_that_keep_the_rules_complete_the_scene():
    done = complete()
    assert done.targets[0].hole_fraction > 0.05
    assert len(done.added) > 0
    assert done.scene.means.isfinite().all()


def with_value(name: str, value: float) -> Callable[[list[View]], Reconstruction]:
    def spoil(views):
        made = reconstruct(views)
        part = getattr(made.gaussians, name).clone()
        part[0] = value
        return replace(made, gaussians=replace(made.gaussians, **{name: part}))

    return spoil


def with_part(name: str, change: Callable) -> Callable[[list[View]], Reconstruction]:
    def spoil(views):
        made = reconstruct(views)
        return replace(made, **{name: change(getattr(made, name))})

    return spoil


def with_depth(change: Callable[[DepthMap], DepthMap]):
    return with_part("depths", lambda depths: (change(depths[0]), depths[1]))


@pytest.mark.parametrize(
    ("reconstructor", "sentence"),
    [
        (with_value("means", math.nan), "positions that are NaN"),
        (with_value("means", 1e19), r"positions that are NaN or beyond 1e\+18"),
        (with_value("quats", 0.0), "rotations of zeros"),
        (with_value("scales", -1.0), "scales that are negative"),
        (with_value("opacities", 1e20), "opacities outside of"),
        (with_value("opacities", math.nan), "opacities outside of"),
        (with_value("sh", math.nan), "harmonics that are NaN"),
        (with_value("generated", 7), "labels Gaussians as generated"),
        (with_part("depths", lambda d: (*d, d[0])), "2 views and returned 3 depth maps"),
        (with_part("depths", lambda d: None), "tuple of one DepthMap per view"),
        (with_part("depths", lambda d: (d[0].depth, d[1].depth)), "tuple of one DepthMap"),
        (with_part("gaussians", lambda g: g.means), "gaussians of a reconstruction have to be"),
        (with_part("gaussians", type), "gaussians of a reconstruction have to be"),
        (with_part("pixel_index", lambda p: p + 10**6), "views or pixels that there are not"),
        (with_part("view_index", lambda v: v - 1), "views or pixels that there are not"),
        (with_part("pixel_index", lambda p: p.float()), "pixel_index of a reconstruction"),
        (with_part("pixel_index", lambda p: p[:-1]), "return as many of each"),
        (with_part("exposure_gains", torch.zeros_like), "three positive float32 numbers"),
        (with_part("exposure_gains", lambda g: g * math.nan), "three positive float32 numbers"),
        (with_part("exposure_gains", lambda g: g[:1]), "have to be 2 rows"),
        (with_part("exposure_gains", lambda g: g[:, 0]), "exposure_gains of a reconstruction"),
        (with_part("notes", lambda notes: "a sentence"), "have to be a tuple of sentences"),
        (with_part("contradicted_depths", lambda numbers: (2,)), "indices of its 2 views"),
        (with_depth(lambda d: replace(d, depth=-d.depth)), "Depth map 0 .* not positive"),
        (with_depth(lambda d: replace(d, depth=d.depth * math.nan)), "Depth map 0 .* is NaN"),
        (with_depth(lambda d: DepthMap(d.depth[1:], d.valid[1:])), "one of the same size"),
        (with_depth(lambda d: replace(d, depth=d.depth.double())), "holds float64"),
        (with_depth(lambda d: replace(d, valid=d.valid[1:])), "parts of a depth map"),
        (lambda views: None, "has to return a Reconstruction, and returned None"),
    ],
)
def test_a_reconstruction_that_no_scene_can_be_is_refused(reconstructor, sentence):
    with pytest.raises(InputError, match=sentence):
        complete(reconstructor=reconstructor)


def painting(change: Callable) -> Callable:
    return lambda *request: change(paint(*request))


class Batch:
    """A generator with a size and an answer of its own."""

    supports_padding = True

    def __init__(self, size: object, answer: object):
        self.max_batch_size = size
        self.answer = answer

    def synthesize(self, requests):
        return self.answer


class PaddingByMethod(Batch):
    """A generator whose answer to `supports_padding` is a method."""

    def supports_padding(self) -> bool:
        return False


def write_into_render(nearest, target, context):
    context.target_render.image[:] = math.nan
    return paint(nearest, target, context)


def write_by_numpy(nearest, target, context):
    nearest.image.numpy()[0] = 0.25
    return paint(nearest, target, context)


@pytest.mark.parametrize(
    ("generator", "sentence"),
    [
        (painting(lambda image: image * 255), r"values from 127.5 to 127.5; colours in \[0, 1\]"),
        (painting(lambda image: image - 5), "values from -4.5 to -4.5"),
        (painting(lambda image: image * math.nan), "values from nan"),
        (painting(lambda image: image.numpy()), "and returned of type ndarray"),
        (painting(lambda image: image.bfloat16()), "a tensor of bfloat16"),
        (painting(lambda image: image.to_sparse()), "a sparse tensor"),
        (painting(lambda image: image[1:]), "has to return a finite image of shape"),
        (painting(lambda image: GeneratorOutput(image, notes=(1,))), "a tuple of sentences"),
        (
            painting(lambda image: GeneratorOutput(image, is_photograph=torch.ones(2))),
            "is_photograph of the generator has to be True or False",
        ),
        (lambda *_: None, "and returned None"),
        (lambda *_: "image", "and returned 'image'"),
        (Batch(0, []), "max_batch_size of the generator .* is 0"),
        (Batch("a", []), "max_batch_size of the generator .* is 'a'"),
        (PaddingByMethod(1, []), "supports_padding of the generator .* of type method"),
        (Batch(1, []), "a list of as many outputs, and returned 0"),
        (Batch(1, None), "a list of as many outputs, and returned None"),
        (Batch(1, [torch.rand(SIZE, SIZE, 3)]), "has to return a GeneratorOutput"),
        (Batch, "is the class Batch instead of an object"),
        (write_into_render, "changed its input"),
    ],
)
def test_an_image_that_no_photograph_can_be_is_refused(generator, sentence):
    with pytest.raises(InputError, match=sentence):
        complete(generator=generator)


def test_writing_into_a_photograph_by_numpy_is_noticed():
    views = [replace(view, image=view.image.clone()) for view in VIEWS]
    with pytest.raises(InputError, match="changed its input"):
        GSCompleter(reconstructor=reconstruct, generator=write_by_numpy)(views, TARGET)


def test_gradients_of_models_are_dropped():
    learned = torch.full((3,), 0.5, requires_grad=True)

    def reconstruct_learned(views):
        made = reconstruct(views)
        opacities = made.gaussians.opacities * (learned[0] + 0.5)
        return replace(made, gaussians=replace(made.gaussians, opacities=opacities))

    done = complete(reconstruct_learned, lambda *request: paint(*request) * (learned + 0.5))
    assert isinstance(done.scene, Gaussians)
    assert not done.scene.opacities.requires_grad
    assert not done.scene.sh.requires_grad
