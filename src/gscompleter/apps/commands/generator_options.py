"""Options `--generator NAME` and `--generator-SETTING VALUE`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from gscompleter.config.generators import GENERATORS, GeneratorSettings, get_settings_class
from gscompleter.config.settings import Settings
from gscompleter.errors import InputError, quote_value

PREFIX = "generator_"


@dataclass(frozen=True)
class GeneratorOptions(Settings):
    """Model that synthesizes images, and its settings."""

    generator: str = "warp-inpaint"
    """Model that synthesizes the image at a target: warp-inpaint (photographs warped to the target,
    holes filled by patches; needs no weights), oracle (the real photograph, for measurements),
    pe-field (the paper's diffusion transformer) or diffusers-inpaint (any inpainting pipeline)."""
    generator_weights: str | None = None
    """Weights of pe-field or diffusers-inpaint: a folder saved by diffusers, or USER/NAME or
    USER/NAME@COMMIT on the Hugging Face hub. By default the published ones of pe-field;
    diffusers-inpaint needs this option."""
    generator_retries: int | None = None
    """Further seeds to try if the image disagrees with the photographs (0)."""
    generator_offload: bool = False
    """Keep only the active part of the model on the GPU, which needs less GPU memory."""
    generator_steps: int | None = None
    """Denoising steps: for pe-field 4, as in the paper (its authors' demo has 28), for
    diffusers-inpaint the pipeline's own number."""
    generator_depth: str | None = None
    """Depth of the photograph for pe-field: context (rendered from the scene), monocular (a
    published network), or the folder or hub id of another network. By default context, or monocular
    with the config `paper`."""
    generator_batch_size: int | None = None
    """Most target images that pe-field denoises together (4). Fewer need less memory."""
    generator_prompt: str | None = None
    """Text prompt of diffusers-inpaint (a photograph)."""

    @property
    def name(self) -> str:
        """Name of the generator."""
        return self.generator

    def make_settings(self) -> GeneratorSettings:
        """Return the settings, or raise InputError if one is unknown to the generator."""
        kind = get_settings_class(self.name)
        values = {name.removeprefix(PREFIX): value for name, value in vars(self).items()}
        given = {
            setting: value
            for setting, value in values.items()
            if setting != "generator" and value is not None and value is not False
        }
        for setting, value in given.items():
            knowing = [name for name, kind in GENERATORS.items() if hasattr(kind, setting)]
            if self.name not in knowing:
                raise InputError(
                    f"The generator {self.name!r} has no setting {setting} ({quote_value(value)}); "
                    f"leave it out, or choose {' or '.join(knowing)}.",
                    PREFIX + setting,
                )
        return kind(**given)

    def describe(self) -> dict[str, Any]:
        """Describe the generator for `summary.json`."""
        settings = asdict(self.make_settings())
        return {"generator": self.name, **{PREFIX + name: settings[name] for name in settings}}
