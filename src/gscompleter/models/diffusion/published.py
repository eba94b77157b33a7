"""Sources of the generators' weights: those of PE-Field, and those that a user names.

Names, sizes and licences are those of the authors' pages; no commit is known. Neither torch nor
diffusers is imported before weights are loaded.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from gscompleter.models.weights.fetching import limit_retries
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.writing import FULL_DISK_ERRORS
from gscompleter.system.memory_errors import is_lack_of_memory, list_causes

PACKAGES = ("diffusers", "transformers", "accelerate")
"""Packages that the generators import."""
INSTALL = "pip install 'gscompleter[diffusion]'"


@dataclass(frozen=True, kw_only=True)
class Source:
    """A folder in the format of diffusers, local or on the hub."""

    location: str
    """Path of the folder, or id of the repository."""
    revision: str | None = None
    """Commit or branch of the repository, or None for a local folder."""
    subfolder: str | None = None
    terms: str = "the licence that its page states"
    """Licence of the weights, as part of a sentence."""

    @property
    def is_local(self) -> bool:
        """True for a local folder."""
        return self.revision is None

    @property
    def is_pinned(self) -> bool:
        """True if the files cannot change: a local folder or a commit."""
        # A branch may move; forty hex digits are a commit.
        revision = self.revision
        return revision is None or (
            len(revision) == 40 and set(revision) <= set("0123456789abcdef")
        )

    @property
    def load_arguments(self) -> dict[str, str]:
        """Further arguments of `from_pretrained`."""
        pairs = {"revision": self.revision, "subfolder": self.subfolder}
        return {key: value for key, value in pairs.items() if value is not None}


KONTEXT = Source(
    location="black-forest-labs/FLUX.1-Kontext-dev",
    revision="main",
    terms=(
        "the FLUX.1 [dev] Non-Commercial License, which must be accepted on its page and needs a "
        "logged-in account (`hf auth login`)"
    ),
)
"""Base model: VAE, text encoders, tokenizers and scheduler; gated."""

PE_FIELD = Source(
    location="yunpeng1998/PE-Field",
    revision="main",
    subfolder="FLUX.1-Kontext-dev/transformer",
    terms=(
        "no known licence of its own; it is fine-tuned from FLUX.1-Kontext-dev, whose "
        "non-commercial licence covers derivatives"
    ),
)
"""Transformer of the authors: 1160 tensors, 23.8 GB in bfloat16."""

PE_FIELD_TRANSFORMER = {
    "patch_size": 1,
    "in_channels": 64,
    "num_layers": 19,
    "num_single_layers": 38,
    "attention_head_dim": 128,
    "num_attention_heads": 24,
    "joint_attention_dim": 4096,
    "pooled_projection_dim": 768,
    "guidance_embeds": True,
    "axes_dims_rope": (16, 56, 56),
}
"""Configuration of that transformer in diffusers."""

LICENCES = {
    "flux.2-klein-4b": "Apache-2.0",
    "flux.2-klein-base-4b": "Apache-2.0",
    "flux.2": "the FLUX Non-Commercial License, and a gated page",
    "flux.1-schnell": "Apache-2.0",
    "z-image": "Apache-2.0",
    "qwen-image": "Apache-2.0",
    "flux": "the FLUX.1 [dev] Non-Commercial License for the [dev] models, and a gated page",
    "stable-diffusion-xl": "CreativeML Open RAIL++-M for Stability's own",
    "stable-diffusion-2": "CreativeML Open RAIL++-M for Stability's own",
    "stable-diffusion-3": "the Stability AI Community License, and a gated page",
    "stable-diffusion": "CreativeML Open RAIL-M for Stability's and Runway's own",
    "depth-anything-v2-small": "Apache-2.0",
}
"""Usual licences of model families, by a part of the repository id in small letters. The first that
fits counts, so that a family comes after its members with licences of their own."""


class IncompleteWeightsError(ValueError):
    """Tensors are missing from the files of a model."""

    def __init__(self, part: str, names: list[str]) -> None:
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        super().__init__(f"its {part} lacks the tensor {names[0]}{more}")


def parse_source(path: str, library: str = "diffusers") -> Source:
    """Parse a user's PATH, USER/NAME or USER/NAME@COMMIT in the format of `library`."""
    # Not by `Path`, which raises errors for a user that does not exist and for long names.
    folder = os.path.expanduser(path)
    if os.path.isdir(folder):
        return Source(location=str(Path(folder)))
    name, _, revision = path.partition("@")
    if name.count("/") != 1 or name.startswith((".", "/", "~")) or name.endswith("/"):
        raise InputError(
            f"There is no folder {quote_value(Path(path))}, and it is no repository of the Hugging "
            f"Face hub either; give a folder that {library} saved, or USER/NAME or "
            "USER/NAME@COMMIT."
        )
    usual = find_usual_licence(name)
    terms = "the licence that its page states" + (f" (usually {usual})" if usual else "")
    return Source(location=name, revision=revision or "main", terms=terms)


def announce(sources: list[Source]) -> None:
    """Print to stderr which weights are downloaded, and under which terms."""
    # A pipeline and its transformer may be of one repository.
    once = {(source.location, source.revision): source for source in sources if not source.is_local}
    for source in once.values():
        page = f"https://huggingface.co/{source.location}"
        pinned = f"at {source.revision!r}, which is not pinned, so the files may change"
        if source.is_pinned:
            pinned = f"at commit {source.revision}"
        print(f"Weights of {page} {pinned}. Terms: {source.terms}.", file=sys.stderr)


def check_packages(name: str) -> None:
    """Raise InputError with an install command if one of `PACKAGES` is missing."""
    missing = [package for package in PACKAGES if find_spec(package) is None]
    if missing:
        raise InputError(
            f"The generator {name!r} needs {', '.join(missing)}; run `{INSTALL}`, or choose "
            "'warp-inpaint', which needs no weights."
        )


def find_usual_licence(name: str) -> str | None:
    """Find the usual licence of the family that a repository id names, or None."""
    return next((terms for part, terms in LICENCES.items() if part in name.lower()), None)


@contextmanager
def convert_load_errors(source: Source, setting: str = "weights") -> Iterator[None]:
    """Silence the libraries and convert failures to InputErrors, which name `setting`.

    A full disk and a lack of memory are no fault of the source, and go on as they are.
    """
    try:
        with silence_libraries(source.is_local), limit_retries():
            yield
    except InputError:
        raise
    except (OSError, ValueError, KeyError, ImportError, AttributeError, RuntimeError) as error:
        if any(is_lack_of_memory(cause) or is_full_disk(cause) for cause in list_causes(error)):
            raise
        raise create_load_error(source, error, setting) from error


def is_full_disk(error: BaseException) -> bool:
    """Return True if an error, without its causes, says that there is no room on the disk."""
    return isinstance(error, OSError) and error.errno in FULL_DISK_ERRORS


@contextmanager
def silence_libraries(is_local: bool) -> Iterator[None]:
    """Limit diffusers and transformers to errors, and to progress bars of downloads.

    Without a download (`is_local`) there is no bar.
    """
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    # The libraries print progress and warnings that mean nothing to a user. What was set before is
    # restored in the end.
    logs = (diffusers_logging, transformers_logging)
    levels = [log.get_verbosity() for log in logs]
    bars = [log for log in logs if is_local and log.is_progress_bar_enabled()]
    for log in logs:
        log.set_verbosity_error()
    for log in bars:
        log.disable_progress_bar()
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.set_verbosity(level)
        for log in bars:
            log.enable_progress_bar()


def create_load_error(source: Source, error: Exception, setting: str) -> InputError:
    """Create the error for a source that failed to load; `setting` named it."""
    page = f"https://huggingface.co/{source.location}"
    if source.is_local:
        way_out = "see that it is complete, as `save_pretrained` writes it"
    elif isinstance(error, IncompleteWeightsError):
        way_out = f"see {page} for how it is loaded, or give a complete folder as its {setting}"
    else:
        way_out = (
            f"see that you accepted its terms at {page} and are logged in, or give a folder "
            f"as its {setting}"
        )
    reason = f"{type(error).__name__}: {quote_value(str(error), 120).rstrip('.')}"
    return InputError(
        f"Could not load {source.location} ({reason}); {way_out}.",
        f"generator_{setting}",
    )
