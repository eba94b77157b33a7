"""Methods refuse what they cannot do before they are run, and say what they did not do."""

from dataclasses import dataclass, replace

import pytest
import torch

from gscompleter import InputError
from gscompleter.evaluation import runner
from gscompleter.evaluation.methods import (
    METHODS,
    STEPS_METHODS,
    Models,
    check_methods,
    check_steps,
    complete_bare,
)
from gscompleter.evaluation.protocols import Task
from gscompleter.evaluation.runner import RunConfig, evaluate
from gscompleter.generators import load_generator
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render.loading import load_renderer
from scenes import Room, camera_at, gaussians_of, view_of
from target_views import begin_with

SIZE = 32
VIEW = view_of(Room(), camera_at(size=SIZE, focal=0.5))
MODELS = Models(
    load_reconstructor("plane-sweep"), load_generator("warp-inpaint"), load_renderer("cpu")
)


class Stepwise:
    """A user's generator with a number of steps that is no field of a dataclass."""

    steps = 4
    supports_padding = True
    max_batch_size = 1

    def synthesize(self, requests):
        return []


@dataclass(frozen=True)
class Denoiser(Stepwise):
    """A generator whose number of steps can be set."""

    steps: int = 4


def test_steps_are_set_in_generators_that_have_them():
    check_steps(["full", "steps-4"], Denoiser())
    for generator in (MODELS.generator, Stepwise()):
        check_steps(["full"], generator)
        with pytest.raises(InputError, match="steps-4 needs a generator with denoising steps"):
            check_steps(["full", "steps-4"], generator)


def test_methods_whose_generator_has_no_steps_are_refused_before_all_tasks(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "check_tasks", lambda tasks: None)
    tasks: list[Task] = []
    with pytest.raises(InputError, match="steps-4 needs a generator with denoising steps"):
        evaluate(tasks, ["context", "steps-4"], tmp_path / "out", RunConfig())
    assert not (tmp_path / "out").exists()


def test_bare_fails_where_nothing_can_be_seen_beside_a_hole():
    state = begin_with(gaussians_of(VIEW), [VIEW])
    away = camera_at(yaw=180, size=SIZE)
    with pytest.raises(InputError, match="No camera around the target sees what is beside"):
        complete_bare(state, away, MODELS)


def test_bare_keeps_a_scene_without_a_hole_and_says_how_long_it_looked():
    state = begin_with(gaussians_of(VIEW), [VIEW])
    K = VIEW.camera.K.clone()
    K[[0, 1], [0, 1]] *= 3
    prediction = complete_bare(state, replace(VIEW.camera, K=K), MODELS)
    assert torch.equal(prediction.scene.means, state.scene.means)
    assert prediction.seconds["total"] >= prediction.seconds["context"] > 0


def test_no_iterations_are_none():
    assert replace(MODELS, baseline_iterations=0).limit_iterations(800) == 0
    assert MODELS.limit_iterations(800) == 800


def test_sentences_name_all_methods():
    with pytest.raises(InputError, match="There is no method 'nope'") as unknown:
        check_methods(["nope"])
    with pytest.raises(InputError, match="changes existing Gaussians") as changing:
        check_methods(["distill"], 2)
    for name in ("bare", *STEPS_METHODS):
        assert f"{name}," in str(unknown.value)
        assert f"{name}," in str(changing.value)
    assert set(STEPS_METHODS) <= set(METHODS)
