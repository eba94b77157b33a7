"""Settings by name and from YAML."""

import pytest

from gscompleter.config import ABLATIONS, CompleterConfig, load_config, named_config
from gscompleter.errors import InputError


def test_the_papers_numbers():
    paper = CompleterConfig.paper()
    assert paper.anchor.max_rotation == 45
    assert (paper.registration.iterations, paper.registration.learning_rate) == (50, 0.01)
    weights = paper.registration
    assert (weights.depth_weight, weights.stereo_weight, weights.rgb_weight) == (1, 1, 0.1)
    assert (paper.registration.step, paper.registration.footprint) == ("literal", "fixed")
    assert not paper.registration.mask_occluded
    assert (paper.holes.max_alpha, paper.holes.dilation) == (0.5, 3)
    assert (paper.refine.iterations, paper.refine.learning_rate) == (30, 0.08)
    assert (paper.refine.target_weight, paper.refine.num_views) == (0.1, 2)
    assert paper.harm.tolerance is None


@pytest.mark.parametrize("name", [n for n in ABLATIONS if n not in ("dilation", "theta-45")])
def test_every_ablation_changes_something_of_the_paper(name):
    assert named_config(f"paper/{name}") != CompleterConfig.paper()


def test_without_anything_is_without_each():
    config = named_config("none")
    assert config.anchor.selection == "nearest"
    assert config.registration.affine.bridge == "none"
    assert config.registration.iterations == 0


def test_a_yaml_file_names_only_what_differs(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("base: paper\nholes: {dilation: 5}\nregistration: {affine: {max_trials: 64}}\n")
    config = load_config(str(file))
    assert config.holes.dilation == 5
    assert config.registration.affine.max_trials == 64
    assert config.registration.step == "literal"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("holes: {dilatation: 5}", "no setting 'dilatation'; choose one of max_alpha, dilation"),
        ("holes: {dilation: many}", "dilation must be int, got 'many'"),
        ("holes: 3", "holes holds settings of its own"),
        ("registration: {step: tiny}", "step must be one of relative, literal"),
        ("harm: {tolerance: true}", "tolerance must be float or null"),
        ("- 1", "must map settings to values"),
        ("a: [", "is not YAML"),
        ("base: papper", "no config 'papper'"),
    ],
)
def test_a_wrong_setting_gets_a_sentence(tmp_path, text, sentence):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=sentence):
        load_config(str(file))


def test_an_unknown_name_or_missing_file_gets_a_sentence():
    with pytest.raises(InputError, match="no config 'no-xy'"):
        load_config("no-xy")
    with pytest.raises(InputError, match="Cannot read the config missing.yaml"):
        load_config("missing.yaml")
