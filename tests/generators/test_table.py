"""Each row of the table of generators does what it says, and has a line in the reference page."""

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, NamedTuple

import pytest
import torch
from annotated_types import Interval

from gscompleter import InputError, load_generator
from gscompleter.apps.command_line.field_texts import read_field_texts
from gscompleter.apps.command_line.words import format_error
from gscompleter.cli import parse_command
from gscompleter.config import generators
from gscompleter.config.generators import (
    GENERATOR_PLUGINS,
    GENERATORS,
    PREFIX,
    GeneratorEntry,
    GeneratorLine,
    GeneratorOptions,
    GeneratorSettings,
    add_options,
    get_settings_class,
    makes_any_image,
)
from gscompleter.config.settings import Settings, Share, validate
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.numerics.smooth import compute_distance_to_known
from gscompleter.system.plugins import load_plugins
from known_room import TARGET, known_room
from paths import ROOT
from scenes import Room, view_of

TRUTH = view_of(Room(), TARGET)
CONTEXT = known_room()
HOLES = CONTEXT.holes
OPTION_START = "generator-"


def continues_the_border(image: torch.Tensor) -> bool:
    """Check that the rim of the holes is closer to the truth than a mean colour is."""
    rim = HOLES & (compute_distance_to_known(~HOLES) <= 4)
    flat = TRUTH.image[~HOLES].mean(dim=0)
    return bool((image - TRUTH.image)[rim].abs().mean() < (flat - TRUTH.image[rim]).abs().mean())


class Filling(NamedTuple):
    """What is true of the image of a generator in the holes of a known room."""

    holds: Callable[[torch.Tensor, Any], bool]
    """Takes the image, and the settings that it was made with."""
    others: Mapping[str, Any] = {}
    """Another value than the default for each setting that is an option, by its name."""


FILLINGS: dict[str, Filling] = {
    "warp-inpaint": Filling(lambda image, settings: continues_the_border(image)),
    "oracle": Filling(lambda image, settings: torch.equal(image, TRUTH.image)),
    "painted": Filling(lambda image, settings: (image - TRUTH.image)[HOLES].abs().mean() < 0.02),
}
"""Fillings by the names of generators."""


def get_filling(name: str) -> Filling:
    assert name in FILLINGS, f"add to FILLINGS what is true of the image of {name}"
    return FILLINGS[name]


def synthesize(name: str, **settings: Any) -> GeneratorOutput:
    """Synthesize the image of a generator, with some settings that are not the default."""
    chosen = GENERATORS[name].settings(**settings)
    phi = load_generator(name, seed=3, photographs=[TRUTH], settings=chosen)
    (output,) = phi.synthesize([GeneratorRequest(CONTEXT.views[1], TARGET, CONTEXT)])
    return output


def test_every_generator_has_its_filling():
    missing = sorted(set(GENERATORS) - set(FILLINGS))
    assert not missing, f"add to FILLINGS what is true of the image of {missing}"
    assert set(FILLINGS) == set(GENERATORS)


@pytest.mark.parametrize("name", GENERATORS)
def test_a_generator_fills_holes_and_shows_what_the_photographs_show(name):
    filling = get_filling(name)
    output = synthesize(name)
    image = output.image
    assert image.shape == TRUTH.image.shape
    assert 0 <= image.min() <= image.max() <= 1
    assert torch.equal(image, synthesize(name).image), "the same seed gives another image"
    # Elsewhere it is far closer to the photographs than one colour for all would be.
    seen = TRUTH.image[~HOLES][None]
    flat = seen.mean(dim=1, keepdim=True).expand_as(seen)
    assert psnr(image[~HOLES][None], seen) > psnr(flat, seen) + 5
    assert filling.holds(image, GENERATORS[name].settings())
    # Painted pixels that pass for a photograph would be believed against the scene.
    assert output.is_photograph == torch.equal(image, TRUTH.image)


@pytest.mark.parametrize("name", GENERATORS)
def test_a_generator_obeys_its_options(name):
    filling = get_filling(name)
    usual = synthesize(name).image
    missing = sorted(set(GENERATORS[name].help) - set(filling.others))
    assert not missing, f"give another value of {missing} in FILLINGS"
    for setting, value in filling.others.items():
        image = synthesize(name, **{setting: value}).image
        assert not torch.equal(image, usual), f"{setting} changes nothing"
        assert filling.holds(image, GENERATORS[name].settings(**{setting: value})), setting


@pytest.mark.parametrize("name", GENERATORS)
def test_a_generator_has_a_line_in_the_reference_page(name):
    page = (ROOT / "docs" / "generators.md").read_text("utf-8")
    is_there = re.search(rf"^\| [^|]*`{name}`[^|]*\|", page, re.M) is not None
    assert is_there, f"run `make pages`, which writes a line for `{name}`"


def test_the_reference_page_says_which_generators_have_an_option():
    page = (ROOT / "docs" / "generators.md").read_text("utf-8")
    rows = re.findall(rf"^\| `--{OPTION_START}([a-z-]+)` \| ([^|]*) \|", page, re.M)
    said = {f"--{OPTION_START}{name}": set(re.findall("`(.+?)`", names)) for name, names in rows}
    assert said == list_options(), "run `make pages`"


def list_options() -> dict[str, set[str]]:
    """List the options of generators, with the names of the generators that have each."""
    names = [*GENERATORS, *load_plugins(GENERATOR_PLUGINS)]
    settings = [f.name for f in fields(GeneratorOptions) if f.name.startswith(PREFIX)]
    return {
        f"--{setting.replace('_', '-')}": {
            name
            for name in names
            if hasattr(get_settings_class(name), setting.removeprefix(PREFIX))
        }
        for setting in settings
    }


@dataclass(frozen=True)
class HazeSettings(GeneratorSettings):
    """Settings of a generator that is not in the table."""

    density: Annotated[float, Interval(ge=0, le=1)] = 0.5
    tint: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    unexplained: int = 3


HAZE = GeneratorEntry(
    what="haze",
    load="a:b",
    line=GeneratorLine(input="nothing", output="haze"),
    settings=HazeSettings,
    help={"density": "Density of the haze (0.5).", "tint": "Its colour (1 1 1)."},
    is_own=False,
)


@pytest.fixture
def haze_options(monkeypatch) -> type[GeneratorOptions]:
    """Return a class of options with those of the haze, whose row is in the table."""
    monkeypatch.setitem(generators.GENERATORS, "haze", HAZE)

    @dataclass(frozen=True)
    @add_options
    class Options(GeneratorOptions):
        """Options with those of the haze."""

        generator: str = "haze"
        more: int = field(default=0)

    return Options


def test_what_a_row_explains_is_an_option(haze_options):
    assert {f.name for f in fields(haze_options)} - {f.name for f in fields(GeneratorOptions)} == {
        "generator_density",
        "generator_tint",
        "more",
    }
    default = asdict(haze_options().make_settings())
    assert default == {"density": 0.5, "tint": (1, 1, 1), "unexplained": 3}
    thick = replace(haze_options(), generator_density=0.9, generator_tint=(0.5, 0.25, 1.0))
    assert thick.make_settings() == HazeSettings(0.9, (0.5, 0.25, 1.0))
    for name, value in (("density", 1.5), ("tint", (0.0, 0.0, 1.5))):
        with pytest.raises(InputError, match=f"^{name} must be less than") as error:
            replace(haze_options(), **{f"generator_{name}": value}).make_settings()
        assert error.value.argument == f"generator_{name}"


def test_a_wrong_setting_of_a_generator_is_told_by_the_name_of_its_option(haze_options):
    @dataclass(frozen=True)
    class CommandOptions(Settings):
        """Options of a command, those of generators among them."""

        synthesis: haze_options

    options = haze_options(generator_tint=(float("nan"), 0.0, 0.0))
    with pytest.raises(InputError, match="^generator_tint must be a finite number, got") as error:
        validate(CommandOptions(options))
    assert error.value.argument == "generator_tint"
    told = format_error(error.value)
    assert told == "generator_tint must be a finite number, got nan (--generator-tint)."


def test_an_option_is_of_one_row():
    """Rows with the same name would share its sentence, and its type."""
    names = [PREFIX + name for row in GENERATORS.values() for name in row.help]
    names += read_field_texts(generators.__name__)["GeneratorOptions"]
    assert sorted(set(names)) == sorted(names)


def test_only_a_generator_of_given_images_leaves_cameras_without_one(haze_options):
    shown = {name for name in GENERATORS if not makes_any_image(name)}
    assert shown == {"oracle", "painted", "haze"}
    assert makes_any_image("a_model_of_mine.py:phi")


def test_the_help_of_the_option_names_every_generator(capsys):
    with pytest.raises(SystemExit):
        parse_command(["complete", "--help"])
    page = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name, entry in GENERATORS.items():
        assert f"{name} ({entry.what})" in page
