"""PE-Field and inpainting pipelines as generators.

The models are tiny and random, so these are smoke tests: results are compared with diffusers, and
generators with the protocol.
"""

from __future__ import annotations

import inspect
import json
import shutil
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch

# Without an import: each process of pytest-xdist would take seconds for it, and one runs the tests.
if not all(map(find_spec, ("diffusers", "transformers", "accelerate"))):
    pytest.skip("needs gscompleter[diffusion]", allow_module_level=True)

from safetensors.torch import load_file, save_file

import tiny_diffusion
from command import run
from gscompleter import InputError, load_generator, load_renderer
from gscompleter.config import SynthesisConfig
from gscompleter.config.generators import get_settings_class
from gscompleter.generators import GeneratorRequest
from gscompleter.models.diffusion import pe_field
from gscompleter.models.diffusion.inpaint import (
    DiffusersInpaint,
    Editor,
    Painter,
    choose_denoising,
    complete_warp,
    get_size_rules,
    load_painter,
)
from gscompleter.models.diffusion.kontext import SIZES, find_nearest_size, resize_antialiased
from gscompleter.models.diffusion.loading import PROMPT, load_kontext
from gscompleter.models.diffusion.pe_field import PEField, group_by_size
from gscompleter.models.diffusion.source_depth import (
    MonocularDepth,
    compute_context_depth,
    load_monocular,
)
from gscompleter.models.settings import DiffusersInpaintSettings, PEFieldSettings
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.types import Gaussians, GeneratorInput, merge
from known_room import TARGET, known_room
from parity import assert_close
from scenes import Room, answer, camera_at, gaussians_of, photographed, view_of
from tiny_depth_model import tiny_model

SIZE = 64


def scene_of(context: GeneratorInput) -> Gaussians:
    return merge([gaussians_of(view) for view in context.views])


@pytest.fixture(scope="module")
def kontext_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models") / "kontext"
    return tiny_diffusion.saved(tiny_diffusion.kontext_pipeline(), folder)


@pytest.fixture(scope="module")
def inpaint_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models") / "inpaint"
    return tiny_diffusion.saved(tiny_diffusion.stable_diffusion(), folder)


@pytest.mark.slow
def test_the_sizes_are_those_of_diffusers_and_the_nearest_aspect_wins():
    from diffusers.pipelines.flux.pipeline_flux_kontext import PREFERRED_KONTEXT_RESOLUTIONS

    assert {(h, w) for w, h in PREFERRED_KONTEXT_RESOLUTIONS} == set(SIZES)
    assert len(SIZES) == 17
    assert find_nearest_size(256, 256) == (1024, 1024)
    assert find_nearest_size(480, 720) == (832, 1248)
    assert find_nearest_size(720, 480) == (1248, 832)
    for height, width in ((256, 448), (448, 256), (360, 640), (193, 640), (640, 360), (96, 100)):
        aspect = width / height
        _, w, h = min((abs(aspect - w / h), w, h) for w, h in PREFERRED_KONTEXT_RESOLUTIONS)
        assert find_nearest_size(height, width) == (h, w)


def test_with_plain_positions_our_loop_is_the_pipeline_of_diffusers(kontext_folder):
    """The same noise, prompt, photograph and steps give the same image."""
    from diffusers import FluxKontextPipeline

    model = load_kontext(str(kontext_folder))
    photograph = view_of(Room(), camera_at(0.0, size=128)).image
    size, grid = (128, 192), (2, 3)
    rows, columns = torch.meshgrid(torch.arange(2.0), torch.arange(3.0), indexing="ij")
    target = torch.stack([torch.zeros(6), rows.flatten(), columns.flatten()], dim=-1)
    rows, columns = torch.meshgrid(torch.arange(2.0), torch.arange(2.0), indexing="ij")
    source = torch.stack([torch.ones(4), rows.flatten(), columns.flatten()], dim=-1)
    target, source = target.repeat(1, 21), source.repeat(1, 21)
    found = model.generate(photograph[None], size, target, source[None], 5, 3, 2.5)[0]

    stock = FluxKontextPipeline.from_pretrained(kontext_folder)
    stock.set_progress_bar_config(disable=True)
    expected = stock(
        image=photograph.permute(2, 0, 1)[None],
        prompt=PROMPT,
        height=size[0],
        width=size[1],
        num_inference_steps=3,
        guidance_scale=2.5,
        generator=torch.Generator().manual_seed(5),
        output_type="pt",
        max_area=size[0] * size[1],
        _auto_resize=False,
    ).images[0]
    assert model.compute_grid(size) == grid
    assert found.std() > 0.01
    assert_close(found, expected.permute(1, 2, 0), "image")


def test_the_text_encoders_leave_memory_and_the_model_is_loaded_once(kontext_folder):
    model = load_kontext(str(kontext_folder))
    assert model.pipeline.text_encoder is None
    assert model.pipeline.text_encoder_2 is None
    assert model.prompt.tokens.shape == (1, 512, 32)
    assert load_kontext(str(kontext_folder)) is model


@pytest.mark.slow
def test_pe_field_depends_on_seed_and_depth_and_on_nothing_else(kontext_folder):
    model, context = load_kontext(str(kontext_folder)), known_room()

    def image(context=context, **changes):
        generator = PEField(model, **({"steps": 1} | changes))
        return answer(generator, context.views[1], TARGET, context).image

    first = image(seed=1)
    assert first.shape == (TARGET.height, TARGET.width, 3)
    assert torch.equal(first, image(seed=1))
    assert not torch.equal(first, image(seed=2))
    renders = tuple(replace(r, depth=r.depth**2) for r in context.view_renders)
    assert not torch.equal(first, image(replace(context, view_renders=renders), seed=1))


@pytest.mark.slow
def test_images_made_together_are_those_made_alone(kontext_folder):
    context, flat = known_room(), camera_at(0.6, yaw=8, size=96)
    flat = replace(flat, height=48)  # another size, which is painted by itself
    targets = [TARGET, camera_at(0.5, yaw=10, size=96), flat, camera_at(0.4, yaw=9, size=96)]
    contexts = [
        replace(context, target_render=load_renderer("cpu").render(scene_of(context), target))
        for target in targets
    ]
    generator = PEField(load_kontext(str(kontext_folder)), steps=2, max_batch_size=2)
    calls = [
        GeneratorRequest(context.views[1], target, known)
        for target, known in zip(targets, contexts, strict=True)
    ]
    conditions = [generator.create_condition(call) for call in calls]
    assert group_by_size(conditions, 2) == [[0, 1], [3], [2]]
    together = [found.image for found in generator.synthesize(calls)]
    alone = [generator.synthesize([call])[0].image for call in calls]
    for image, expected in zip(together, alone, strict=True):
        assert_close(image, expected, "image", 1e-5)
    assert (together[0] - together[1]).abs().max() > 1e-4


@pytest.mark.slow
def test_pe_field_takes_the_depth_that_the_completer_names(kontext_folder, tmp_path, monkeypatch):
    """`paper()` names a monocular network, the default the scene."""
    network = load_monocular(str(tiny_model(tmp_path)))
    named = {"context": compute_context_depth, "monocular": network}
    monkeypatch.setattr(pe_field, "load_source_depth", lambda name, device: named[name])
    context = known_room()
    generator = PEField(load_kontext(str(kontext_folder)), steps=1)

    def image(generator, source):
        synthesis = SynthesisConfig(source_depth=source, correct_color=False)
        request = GeneratorRequest(context.views[1], TARGET, context, synthesis)
        return generator.synthesize([request])[0].image

    found = {source: image(generator, source) for source in named}
    for source, depth in named.items():
        assert torch.equal(found[source], image(replace(generator, depth=depth), "context"))
    assert not torch.equal(found["context"], found["monocular"])


@pytest.mark.slow
def test_further_seeds_are_tried_and_the_best_is_kept(kontext_folder):
    context = known_room()
    generator = load_generator(
        "pe-field", 7, settings=PEFieldSettings(str(kontext_folder), steps=1, retries=2)
    )
    best = answer(generator, context.views[1], TARGET, context)
    assert "best of 3 seeds" in best.notes[0]
    single = replace(generator, retries=0)
    seeds = [
        answer(replace(single, seed=7 + i), context.views[1], TARGET, context).image
        for i in range(3)
    ]
    assert sum(bool(torch.equal(best.image, one)) for one in seeds) == 1


def test_settings_reach_the_generators(kontext_folder, inpaint_folder, tmp_path):
    chosen_settings = PEFieldSettings(str(kontext_folder), steps=3, retries=2, batch_size=1)
    generator = load_generator("pe-field", 5, settings=chosen_settings)
    assert (generator.seed, generator.steps, generator.retries) == (5, 3, 2)
    assert generator.max_batch_size == 1
    assert generator.depth is None
    chosen = load_generator("pe-field", settings=replace(chosen_settings, depth="context"))
    assert chosen.depth is compute_context_depth
    assert load_generator("pe-field", settings=PEFieldSettings(chosen_settings.weights)).steps == 4
    network = tiny_model(tmp_path)
    with_depth = load_generator("pe-field", settings=replace(chosen_settings, depth=str(network)))
    assert isinstance(with_depth.depth, MonocularDepth)
    chosen_settings = DiffusersInpaintSettings(
        str(inpaint_folder), steps=3, retries=1, prompt="a quiet street"
    )
    painter = load_generator("diffusers-inpaint", settings=chosen_settings)
    assert (painter.prompt, painter.steps, painter.retries) == ("a quiet street", 3, 1)


def test_an_inpainter_reads_its_prompt(inpaint_folder):
    context = known_room()
    chosen_settings = DiffusersInpaintSettings(
        str(inpaint_folder), steps=2, prompt="a quiet street"
    )
    painter = load_generator("diffusers-inpaint", settings=chosen_settings)
    other = replace(painter, prompt="a b c")
    images = [answer(one, context.views[1], TARGET, context).image for one in (painter, other)]
    assert not torch.equal(*images)


def test_noise_in_place_of_the_scene_is_told(kontext_folder):
    context = known_room()
    generator = PEField(load_kontext(str(kontext_folder)), steps=1)
    notes = answer(generator, context.views[1], TARGET, context).notes
    assert len(notes) == 1
    assert "disagrees with the photographs" in notes[0]


def test_a_scene_that_the_photograph_does_not_see_is_refused(kontext_folder):
    context = known_room()
    empty = tuple(replace(r, alpha=0 * r.alpha) for r in context.view_renders)
    with pytest.raises(InputError, match="sees nothing of the scene"):
        answer(
            PEField(load_kontext(str(kontext_folder))),
            context.views[1],
            TARGET,
            replace(context, view_renders=empty),
        )


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name.startswith("stable-diffusion") else pytest.mark.slow)
        for name in tiny_diffusion.INPAINTERS
    ],
)
def test_inpainting_keeps_what_was_warped_and_fills_the_rest(name, tmp_path):
    folder = tiny_diffusion.saved(tiny_diffusion.INPAINTERS[name](), tmp_path)
    context, painter = known_room(), load_painter(str(folder))
    painter = replace(painter, side=min(painter.side, 256))  # Flux counts 128 latents
    generator = DiffusersInpaint(painter, steps=2)
    image = answer(generator, context.views[1], TARGET, context).image
    warped = complete_warp(context.views[1], TARGET, context)
    assert 0.05 < (~warped.known).float().mean() < 0.9
    assert torch.equal(image[warped.known], warped.image[warped.known])
    assert (image - warped.image)[~warped.known].abs().mean() > 0.01
    assert image.min() >= 0
    assert image.max() <= 1
    assert torch.equal(image, answer(generator, context.views[1], TARGET, context).image)
    other = answer(replace(generator, seed=1), context.views[1], TARGET, context).image
    assert not torch.equal(image, other)


def test_where_photographs_show_all_no_network_is_asked(inpaint_folder, monkeypatch):
    """At a photograph's own camera nothing is missing."""
    context, painter = known_room(), load_painter(str(inpaint_folder))
    nearest = context.views[1]
    own = replace(context, target_render=context.view_renders[1])
    warped = complete_warp(nearest, nearest.camera, own)
    assert warped.known.all()
    monkeypatch.setattr(Painter, "fill_hole", lambda *_: pytest.fail("it paints"))
    output = answer(DiffusersInpaint(painter), nearest, nearest.camera, own)
    assert torch.equal(output.image, warped.image)
    assert output.notes == ()
    assert not output.is_inconsistent


def test_flux2_klein_edits_what_is_painted_over_and_gets_no_mask(tmp_path):
    folder = tiny_diffusion.saved(tiny_diffusion.flux2_klein(), tmp_path)
    kind = get_settings_class("flux2-klein")
    assert (kind().steps, kind().weights.partition("@")[0]) == (
        4,
        "black-forest-labs/FLUX.2-klein-4B",
    )
    settings = kind(weights=str(folder), prompt="a red room")
    generator = load_generator("flux2-klein", settings=settings)
    assert type(generator.painter) is Editor
    painter = replace(generator.painter, side=128)
    assert type(painter.pipeline).__name__ == "Flux2KleinPipeline"
    context, seen = known_room(), {}
    call = type(painter.pipeline).__call__

    class Watched(type(painter.pipeline)):
        def __call__(self, **given):
            seen.update(given)
            return call(self, **given)

    painter.pipeline.__class__ = Watched
    nearest = context.views[1]
    answer(replace(generator, painter=painter), nearest, TARGET, context)
    assert {"mask_image", "strength"}.isdisjoint(seen)
    assert seen["num_inference_steps"] == 4
    assert seen["guidance_scale"] == 1.0
    assert seen["prompt"].endswith("Change nothing else: a red room.")

    # The hole is green in the first image; the second is the nearest photograph.
    over, reference = (np.array(image) for image in seen["image"])
    assert np.array_equal(reference, convert_to_pixels(nearest.image))
    hole = ~complete_warp(nearest, TARGET, context).known
    shown = resize_antialiased(hole[..., None].float(), over.shape[:2])[..., 0].numpy() > 0.999
    assert shown.any()
    assert (over[shown] == (0, 255, 0)).all()
    assert not (over == (0, 255, 0)).all(axis=-1).all()


def test_a_base_model_of_flux2_klein_is_guided_as_its_pipeline_does(tmp_path):
    pipeline = tiny_diffusion.flux2_klein()
    pipeline.register_to_config(is_distilled=False)
    folder = tiny_diffusion.saved(pipeline, tmp_path)
    painter = replace(load_painter(str(folder)), side=64)
    context = known_room()
    answer(DiffusersInpaint(painter, steps=1), context.views[1], TARGET, context)
    assert painter.pipeline.guidance_scale == 4.0
    assert painter.pipeline.do_classifier_free_guidance


@pytest.mark.parametrize(("shift", "scale"), [(3.0, 0.0), (6.0, 5.0)], ids=["turbo", "base"])
def test_only_z_image_turbo_paints_without_guidance(shift, scale, tmp_path):
    """Its distillation leaves no use for guidance, which the pipeline has by default."""
    pipeline = tiny_diffusion.z_image()
    pipeline.scheduler.register_to_config(shift=shift)
    folder = tiny_diffusion.saved(pipeline, tmp_path)
    painter = replace(load_painter(str(folder)), side=64)
    context = known_room()
    answer(DiffusersInpaint(painter, steps=1), context.views[1], TARGET, context)
    assert painter.pipeline.guidance_scale == scale
    assert painter.pipeline.do_classifier_free_guidance == (scale > 0)


def make_without_parts(name: str):
    """Make a pipeline of diffusers whose networks are missing."""
    import diffusers

    kind = getattr(diffusers, name)
    required = [
        parameter.name
        for parameter in inspect.signature(kind).parameters.values()
        if parameter.default is inspect.Parameter.empty
    ]
    return kind(**dict.fromkeys(required))


def test_qwen_image_is_guided_as_its_authors_do_and_flux_by_its_network():
    """Without a negative prompt the pipeline of Qwen-Image leaves its guidance out."""
    qwen, flux = map(make_without_parts, ("QwenImageInpaintPipeline", "FluxInpaintPipeline"))
    assert choose_denoising(qwen, 20) == {"num_inference_steps": 20, "negative_prompt": " "}
    assert choose_denoising(flux, None) == {}


@pytest.mark.parametrize(
    "name", ["FluxFillPipeline", "FluxInpaintPipeline", "QwenImageInpaintPipeline"]
)
def test_a_transformer_paints_at_the_size_that_its_pipeline_records(name):
    assert get_size_rules(make_without_parts(name)) == (1024, 16)


def test_z_image_paints_at_its_own_size_though_its_pipeline_records_none(tmp_path):
    painter = load_painter(str(tiny_diffusion.saved(tiny_diffusion.z_image(), tmp_path)))
    assert not hasattr(painter.pipeline, "default_sample_size")
    assert painter.side == 1024
    assert painter.compute_size(300, 300) == (1024, 1024)


def test_the_size_follows_the_pipeline_and_the_aspect(inpaint_folder):
    painter = load_painter(str(inpaint_folder))
    assert (painter.side, painter.multiple) == (64, 4)
    assert painter.compute_size(500, 500) == (64, 64)
    h, w = painter.compute_size(200, 800)
    assert (h % 4, w % 4) == (0, 0)
    assert h * w == pytest.approx(64 * 64, rel=0.1)
    assert w / h == pytest.approx(4, rel=0.15)


def test_a_pipeline_of_another_kind_is_refused(tmp_path, kontext_folder):
    with pytest.raises(InputError, match="has 12 heads"):
        folder = tiny_diffusion.saved(tiny_diffusion.kontext_pipeline(heads=12), tmp_path / "few")
        load_generator("pe-field", settings=PEFieldSettings(weights=str(folder)))
    (tmp_path / "empty").mkdir()
    empty = str(tmp_path / "empty")
    with pytest.raises(InputError, match="neither a model_index.json"):
        load_generator("pe-field", settings=PEFieldSettings(weights=empty))
    with pytest.raises(InputError, match="Could not load"):
        load_generator("diffusers-inpaint", settings=DiffusersInpaintSettings(weights=empty))


def test_a_checker_of_images_is_no_exception(tmp_path):
    """Older class names are translated by diffusers."""
    folder = tiny_diffusion.saved(tiny_diffusion.checked_stable_diffusion(), tmp_path / "whole")
    index = json.loads((folder / "model_index.json").read_text())
    index["feature_extractor"] = ["transformers", "CLIPFeatureExtractor"]
    (folder / "model_index.json").write_text(json.dumps(index))
    generator = load_generator("diffusers-inpaint", settings=DiffusersInpaintSettings(str(folder)))
    assert generator.painter.pipeline.safety_checker is not None
    broken = tmp_path / "broken"
    shutil.copytree(folder, broken)
    (file,) = (broken / "safety_checker").glob("*.safetensors")
    weights = load_file(file)
    weights.pop(next(name for name in sorted(weights) if "mlp.fc2.weight" in name))
    save_file(weights, file, metadata={"format": "pt"})
    with pytest.raises(InputError, match="its safety_checker lacks the tensor"):
        load_generator("diffusers-inpaint", settings=DiffusersInpaintSettings(str(broken)))


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("pe-field", "transformer"),
        ("pe-field", "vae"),
        ("pe-field", "text_encoder_2"),
        ("diffusers-inpaint", "unet"),
        ("diffusers-inpaint", "text_encoder"),
    ],
)
def test_weights_that_lack_a_tensor_are_refused_and_never_made_up(
    name, part, kontext_folder, inpaint_folder, tmp_path
):
    folder = tmp_path / "broken"
    shutil.copytree(kontext_folder if name == "pe-field" else inpaint_folder, folder)
    (file,) = (folder / part).glob("*.safetensors")
    weights = load_file(file)
    weights.pop(sorted(weights)[len(weights) // 2])
    save_file(weights, file, metadata={"format": "pt"})
    with pytest.raises(InputError, match=f"its {part} lacks the tensor"):
        load_generator(name, settings=get_settings_class(name)(str(folder)))


def completed(tmp_path, monkeypatch, *model) -> dict:
    """Complete the room by the command line and return the summary."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    photographed(scene, [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.6)])
    command = ["complete", scene, "--context", 0, 1, "--target", 2]
    command += ["--near", 0.5, "--far", 20, "--device", "cpu", "--out", out, "--quiet", *model]
    assert run(monkeypatch, *command) == 0
    assert (out / "completed.ply").is_file()
    assert (out / "images" / "target1_reference.png").is_file()
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pe-field", "diffusers-inpaint"])
def test_a_smoke_test_of_a_whole_completion_with_random_weights(
    name, kontext_folder, inpaint_folder, tmp_path, monkeypatch
):
    folder = kontext_folder if name == "pe-field" else inpaint_folder
    words = ["--generator", name, "--generator-weights", folder]
    words += ["--generator-steps", 2, "--generator-retries", 1]
    summary = completed(tmp_path, monkeypatch, *words)
    assert summary["settings"]["generator"] == name
    assert summary["settings"]["generator_weights"] == str(folder)
    assert summary["settings"]["generator_steps"] == 2
    assert summary["targets"][0]["hole_fraction"] > 0
    if name == "pe-field":
        notes = " ".join(summary["targets"][0]["notes"])
        assert "disagrees with the photographs" in notes
        assert "best of 2 seeds" in notes


# The test before completes with the same options, and `tests/evaluation/test_runs.py` evaluates.
@pytest.mark.slow
def test_a_smoke_test_of_an_evaluation_with_random_weights(inpaint_folder, tmp_path, monkeypatch):
    photographed(tmp_path / "room", [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.6)])
    case = {"scene": "room", "context": [0, 1], "target": 2, "near": 0.5, "far": 20.0}
    content = {"resolution": [SIZE, SIZE], "cases": [case]}
    (tmp_path / "cases.json").write_text(json.dumps(content))
    words = ["evaluate", tmp_path / "cases.json", "--methods", "full", "--out", tmp_path / "out"]
    words += ["--generator", "diffusers-inpaint", "--generator-weights", inpaint_folder, "--quiet"]
    assert run(monkeypatch, *words, "--generator-steps", 2, "--device", "cpu") == 0
    remembered = json.loads((tmp_path / "out" / "run.json").read_text())
    assert remembered["generator_steps"] == 2
    assert remembered["generator_weights"] == str(inpaint_folder)
    (row,) = (tmp_path / "out" / "tasks").glob("*/full.json")
    assert json.loads(row.read_text())["error"] is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pe-field", "diffusers-inpaint"])
def test_a_smoke_test_on_photographs_with_random_weights(
    name, kontext_folder, inpaint_folder, shared, tmp_path, monkeypatch
):
    scene, out = shared / "data" / "re10k_000c3ab1", tmp_path / "out"
    if not scene.is_dir():
        pytest.skip(f"needs the photographs in {scene}")
    folder = kontext_folder if name == "pe-field" else inpaint_folder
    command = ["complete", scene, "--context", 0, 4, "--target", 12]
    command += ["--resolution", 96, 128, "--near", 1, "--far", 100, "--device", "cpu"]
    command += ["--generator", name, "--generator-weights", folder, "--out", out, "--quiet"]
    assert run(monkeypatch, *command) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["targets"][0]["hole_fraction"] > 0
    assert (out / "images" / "target1_reference.png").is_file()
    if name == "pe-field":
        assert "disagrees with the photographs" in " ".join(summary["targets"][0]["notes"])
