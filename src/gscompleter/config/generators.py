"""The choice of a generator, and its settings as options. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

from annotated_types import Len

from gscompleter.config.settings import Settings, validate
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_plugins


@dataclass(frozen=True)
class GeneratorSettings(Settings):
    """Settings of a generator; each is an option that the class `GeneratorOptions` explains."""


@dataclass(frozen=True)
class PaintedSettings(GeneratorSettings):
    """Images that were painted elsewhere."""

    painter: Annotated[str, Len(1, 100)] = "an unnamed painter"
    """Name of the program, model or person."""


BUILT_IN: dict[str, type[GeneratorSettings]] = {
    "warp-inpaint": GeneratorSettings,
    "oracle": GeneratorSettings,
    "painted": PaintedSettings,
}
"""Settings of the built-in generators."""

PREFIX = "generator_"

PLUGINS = "gscompleter.generators"
"""Group of entry points that name tables of further generators, from name to loader.

A loader that takes settings has their class as its attribute `settings`.
"""


def get_settings_class(name: str) -> type[GeneratorSettings]:
    """Return the class of a generator's settings, or raise InputError for an unknown name.

    A generator of a file, `file.py:function`, has no settings here.
    """
    if is_in_file(name):
        return GeneratorSettings
    if isinstance(name, str) and name in BUILT_IN:
        return BUILT_IN[name]
    others = load_plugins(PLUGINS)
    if isinstance(name, str) and name in others:
        return getattr(others[name], "settings", GeneratorSettings)
    raise InputError(
        f"There is no generator '{quote_value(name)}'; choose one of "
        f"{', '.join([*BUILT_IN, *others])}, or name a function as file.py:function.",
        "generator",
    )


@dataclass(frozen=True)
class GeneratorOptions(Settings):
    """Model that synthesizes images, and its settings."""

    generator: str = "warp-inpaint"
    """Model that synthesizes the image at a target. It is warp-inpaint (warped photographs,
    holes filled by patches), oracle (the real photograph), painted (by `complete --images`),
    pe-field (the paper's), diffusers-inpaint, one of the other models that docs/generators.md
    lists, or a function of yours as file.py:function."""
    generator_weights: str | None = None
    """Weights, by default those published: a folder saved by diffusers, USER/NAME or
    USER/NAME@COMMIT on the Hugging Face hub for pe-field and diffusers-inpaint (which has no
    default), and a file for others."""
    generator_retries: int | None = None
    """Further seeds to try if the image disagrees with the photographs (0)."""
    generator_offload: bool = False
    """Keep only the active part of the model on the GPU, to need less GPU memory."""
    generator_steps: int | None = None
    """Denoising steps: for pe-field 4, as in the paper (its authors' demo has 28), for
    diffusers-inpaint the pipeline's own number."""
    generator_depth: str | None = None
    """Depth of the photograph for pe-field: context (rendered; the default), moge-2-large (that of
    its authors; with the config `paper`), monocular (a small network), or the folder or hub id of
    another one."""
    generator_batch_size: int | None = None
    """Most target images that pe-field denoises together (4). Fewer need less memory."""
    generator_prompt: str | None = None
    """Text prompt of diffusers-inpaint (a photograph)."""

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
                names = [*BUILT_IN, *load_plugins(PLUGINS)]
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
