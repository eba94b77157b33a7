"""The table of generators, and the choice of one with its settings as options.

Nothing here needs torch, so that help pages wait for nothing that computes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

from annotated_types import Interval as Interval
from annotated_types import Len
from typing_extensions import Doc

# What is imported `as` itself is at hand for the settings of further rows.
from gscompleter.config.settings import Count as Count
from gscompleter.config.settings import Settings, validate
from gscompleter.config.settings import Share as Share
from gscompleter.config.settings import Weight as Weight
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_plugins


@dataclass(frozen=True)
class GeneratorSettings(Settings):
    """Settings of a generator."""


@dataclass(frozen=True, kw_only=True)
class GeneratorLine:
    """Texts of a generator in the table of `docs/generators.md`."""

    input: str
    """Input of the image, such as photographs."""
    output: str
    """Content of the image, in the hole and beside it."""
    needs: str = "nothing"
    """Packages, weights and files that have to be at hand."""


@dataclass(frozen=True, kw_only=True)
class GeneratorEntry:
    """All that is known of a built-in generator: a row of the table."""

    what: str
    """What its image is, as a clause for help pages."""
    load: str
    """Loader as `module:function`: settings, seed, images of the targets, device -> Φ."""
    line: GeneratorLine
    settings: type[GeneratorSettings] = GeneratorSettings
    help: Mapping[str, str] = field(default_factory=dict)
    """Sentence about each setting that is the option `--generator-NAME`, by its name. A setting of
    several numbers is a tuple of them."""
    is_own: bool = True
    """True if the image is made here, for any camera; False if it is one of the target that is
    given, a photograph or somebody's painting, of which the record states no licence of ours."""


GENERATORS: dict[str, GeneratorEntry] = {}
"""Built-in generators by name: the rows that follow, each below the class of its settings if it has
one."""

GENERATORS["warp-inpaint"] = GeneratorEntry(
    what="warped photographs, holes filled by patches",
    load="gscompleter.generators.warp_inpaint:load_warp_inpaint",
    line=GeneratorLine(
        input="all photographs, the scene at all cameras",
        output="photographs warped through the scene's depth; tone and lines of the border go on "
        "into holes, patches where no line leads",
    ),
)

GENERATORS["oracle"] = GeneratorEntry(
    what="the real photograph",
    load="gscompleter.generators.oracle:load_oracle",
    line=GeneratorLine(
        input="the photograph of the target",
        output="that photograph",
        needs="the true image: for measuring geometry alone",
    ),
    is_own=False,
)


@dataclass(frozen=True)
class PaintedSettings(GeneratorSettings):
    """Images that were painted elsewhere."""

    painter: Annotated[str, Len(1, 100)] = "an unnamed painter"
    """Name of the program, model or person; an option of its own, beside that of the images."""


GENERATORS["painted"] = GeneratorEntry(
    what="by `complete --images`",
    load="gscompleter.generators.painted:load_painted",
    line=GeneratorLine(
        input="images that were painted elsewhere (`--images`)",
        output="the painting in the hole, in the exposure of the scene; the scene elsewhere",
        needs="[your own painter](guide/painting.md)",
    ),
    settings=PaintedSettings,
    is_own=False,
)

PREFIX = "generator_"
"""Start of the names of their settings as options."""
CHOICE = (
    "Model that synthesizes the image at a target. It is "
    f"{', '.join(f'{name} ({entry.what})' for name, entry in GENERATORS.items())}, pe-field (the "
    "paper's), diffusers-inpaint, one of the other models that docs/generators.md lists, or a "
    "function of yours as file.py:function."
)
"""Help of the option `--generator`."""
SettingsClass = TypeVar("SettingsClass")

GENERATOR_PLUGINS = "gscompleter.generators"
"""Group of entry points that name tables of further generators, from name to loader.

A loader that takes settings has their class as its attribute `settings`.
"""


def get_settings_class(name: str) -> type[GeneratorSettings]:
    """Return the class of a generator's settings, or raise InputError for an unknown name.

    A generator of a file, `file.py:function`, has no settings here.
    """
    if is_in_file(name):
        return GeneratorSettings
    if isinstance(name, str) and name in GENERATORS:
        return GENERATORS[name].settings
    others = load_plugins(GENERATOR_PLUGINS)
    if isinstance(name, str) and name in others:
        return getattr(others[name], "settings", GeneratorSettings)
    raise InputError(
        f"There is no generator '{quote_value(name)}'; choose one of "
        f"{', '.join([*GENERATORS, *others])}, or name a function as file.py:function.",
        "generator",
    )


def makes_any_image(name: str) -> bool:
    """Return True if a generator makes an image for any camera, and not only shows given ones."""
    return name not in GENERATORS or GENERATORS[name].is_own


def add_options(kind: type[SettingsClass]) -> type[SettingsClass]:
    """Add to a class of options a field for each setting that a row of the table explains.

    None, their default, leaves the setting to the generator.
    """
    annotated: Any = Annotated  # a type checker cannot read a type that is looked up
    for entry in GENERATORS.values():
        # Without their ranges, which the settings check: a sentence then names the option.
        types = get_type_hints(entry.settings)
        for name, sentence in entry.help.items():
            kind.__annotations__[PREFIX + name] = annotated[types[name] | None, Doc(sentence)]
            setattr(kind, PREFIX + name, None)
    return kind


@dataclass(frozen=True)
@add_options
class GeneratorOptions(Settings):
    """Model that synthesizes images, and its settings."""

    has_plain_options: ClassVar[bool] = True
    generator: Annotated[str, Doc(CHOICE)] = "warp-inpaint"
    generator_weights: str | None = None
    """Weights, by default those published: a folder saved by diffusers, USER/NAME or
    USER/NAME@COMMIT on the Hugging Face hub for pe-field and diffusers-inpaint (which has no
    default), and a file for others."""
    generator_retries: int | None = None
    """Further seeds to try if the image disagrees with the photographs (0)."""
    generator_offload: bool = False
    """Keep only the active part of the model on the GPU, to need less GPU memory."""
    generator_steps: int | None = None
    """Denoising steps: for pe-field 4, as in the paper (its authors' demo has 28), for flux2-klein
    4, for diffusers-inpaint the pipeline's own number."""
    generator_depth: str | None = None
    """Depth of the photograph for pe-field: context (rendered; the default), moge-2-large (that of
    its authors; with the config `paper`), moge-2, monocular (a small network), or the folder or hub
    id of another one."""
    generator_batch_size: int | None = None
    """Most target images that pe-field denoises together (4). Fewer need less memory."""
    generator_prompt: str | None = None
    """Text prompt of diffusers-inpaint and flux2-klein (a photograph)."""

    def make_settings(self) -> GeneratorSettings:
        """Return the settings; raise InputError if one is unknown to the generator or wrong."""
        kind = get_settings_class(self.generator)

        # None and False are the defaults of the options: the generator then has its own.
        settings = {
            name.removeprefix(PREFIX): value
            for name, value in vars(self).items()
            if name.startswith(PREFIX) and value is not None and value is not False
        }
        # Refused, not ignored: the user would believe that the setting was obeyed.
        for setting in settings:
            if not hasattr(kind, setting):
                names = [*GENERATORS, *load_plugins(GENERATOR_PLUGINS)]
                knowing = [name for name in names if hasattr(get_settings_class(name), setting)]
                raise InputError(
                    f"The generator '{self.generator}' has no setting {setting}; leave it out, or "
                    f"choose {' or '.join(knowing)}.",
                    PREFIX + setting,
                )
        return validate(kind(**settings), PREFIX)

    def describe(self) -> dict[str, Any]:
        """Describe the generator for `summary.json`."""
        settings = asdict(self.make_settings())
        return {"generator": self.generator, **{PREFIX + name: settings[name] for name in settings}}


@dataclass(frozen=True)
class PaintedOptions(GeneratorOptions):
    """The generator of painted images, which the options of their folder choose."""

    generator: str = "painted"
    generator_painter: str | None = None
