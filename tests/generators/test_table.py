"""Each row of the table of generators does what it says, and has a line in the reference page."""

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated

import pytest
import torch
from annotated_types import Interval

from gscompleter import InputError, load_generator
from gscompleter.cli import parse_command
from gscompleter.config import generators
from gscompleter.config.generators import (
    GENERATOR_PLUGINS,
    GENERATORS,
    PREFIX,
    GeneratorEntry,
    GeneratorOptions,
    GeneratorSettings,
    add_options,
    get_settings_class,
)
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators import GeneratorRequest
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


FILLINGS: dict[str, Callable[[torch.Tensor], bool]] = {
    "warp-inpaint": continues_the_border,
    "oracle": lambda image: torch.equal(image, TRUTH.image),
    "painted": lambda image: bool((image - TRUTH.image)[HOLES].abs().mean() < 0.02),
}
"""What is true of the image of each generator in the holes of a known room, by its name."""


def test_every_generator_has_its_filling():
    missing = sorted(set(GENERATORS) - set(FILLINGS))
    assert not missing, f"add to FILLINGS what is true of the image of {missing}"
    assert set(FILLINGS) == set(GENERATORS)


@pytest.mark.parametrize("name", FILLINGS)
def test_a_generator_fills_holes_and_shows_what_the_photographs_show(name):
    images = []
    for _ in range(2):
        phi = load_generator(name, seed=3, photographs=[TRUTH])
        request = GeneratorRequest(CONTEXT.views[1], TARGET, CONTEXT)
        (output,) = phi.synthesize([request])
        images.append(output.image)
    image = images[0]
    assert image.shape == TRUTH.image.shape
    assert 0 <= image.min() <= image.max() <= 1
    assert torch.equal(image, images[1])
    # Elsewhere it is far closer to the photographs than one colour for all would be.
    seen = TRUTH.image[~HOLES][None]
    flat = seen.mean(dim=1, keepdim=True).expand_as(seen)
    assert psnr(image[~HOLES][None], seen) > psnr(flat, seen) + 5
    assert FILLINGS[name](image)
    # Painted pixels that pass for a photograph would be believed against the scene.
    assert output.is_photograph == torch.equal(image, TRUTH.image)


@pytest.mark.parametrize("name", GENERATORS)
def test_a_generator_has_a_line_in_the_reference_page(name):
    page = (ROOT / "docs" / "generators.md").read_text("utf-8")
    is_there = re.search(rf"^\| [^|]*`{name}`[^|]*\|", page, re.M) is not None
    assert is_there, f"add a line for `{name}` to the first table of docs/generators.md"


def test_the_reference_page_says_which_generators_have_an_option():
    page = (ROOT / "docs" / "generators.md").read_text("utf-8")
    rows = re.findall(rf"^\| `--{OPTION_START}([a-z-]+)` \| ([^|]*) \|", page, re.M)
    said = {f"--{OPTION_START}{name}": set(re.findall("`(.+?)`", names)) for name, names in rows}
    assert said == list_options(), "correct the table of options of docs/generators.md"


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
    unexplained: int = 3


HAZE = GeneratorEntry("haze", "a:b", HazeSettings, {"density": "Density of the haze (0.5)."})


def test_what_a_row_explains_is_an_option(monkeypatch):
    monkeypatch.setitem(generators.GENERATORS, "haze", HAZE)

    @dataclass(frozen=True)
    @add_options
    class Options(GeneratorOptions):
        """Options with those of the haze."""

        generator: str = "haze"
        more: int = field(default=0)

    assert {f.name for f in fields(Options)} - {f.name for f in fields(GeneratorOptions)} == {
        "generator_density",
        "more",
    }
    assert asdict(Options().make_settings()) == {"density": 0.5, "unexplained": 3}
    thick = replace(Options(), generator_density=0.9)
    assert thick.make_settings() == HazeSettings(0.9)
    with pytest.raises(InputError, match="density") as error:
        replace(Options(), generator_density=1.5).make_settings()
    assert error.value.argument == "generator_density"


def test_the_help_of_the_option_names_every_generator(capsys):
    with pytest.raises(SystemExit):
        parse_command(["complete", "--help"])
    page = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name, entry in GENERATORS.items():
        assert f"{name} ({entry.what})" in page
